"""From the names in a request to what they stand for, checked at the time of submission."""

import json
import secrets
from typing import Any

from prtbake_service.backend import Backend
from prtbake_storage.contract.brdf import LambertSpec
from prtbake_storage.contract.jobs import (
    AnyRequest,
    AssetRequest,
    BakeRequest,
    CalibrateRequest,
    CompressRequest,
    FitLightRequest,
    JobState,
    RenderRequest,
    StudyRequest,
    ValidateRequest,
)
from prtbake_storage.contract.materials import (
    Material,
    material_pointer,
    refuse_two_sided_medium,
    require_groups,
    require_lambert,
)
from prtbake_storage.contract.resources import Resource
from prtbake_storage.contract.study import describe
from prtbake_storage.errors import Conflict, InputError, NotFound, SettingsError

Context = dict[str, Any]

_FILES = {
    "transfer": ("transfer.h5",),
    "asset": ("asset.h5", "asset-float32.h5"),
    "exact": ("asset-float32.h5",),
    "light": ("light.h5",),
}
"""Role of an artefact in a request -> the names that jobs give to files of that kind."""

_NAMES_NOTHING = {"settings", "seed", "label", "priority", "timeout_s", "quality", "effects"}
"""Fields of a request that refer to nothing: points that differ in these share their context."""


MOST_NONCE = 1 << 31
"""A seed's limit: what a calibration times is seeded by its nonce, lest it be remembered."""


class Resolver:
    """Resolve the references of one project's requests.

    Every method raises `NotFound` for what the project does not have, `Conflict` for what is there
    but cannot be used (yet) and `InputError` for what is of another kind, with the pointer to the
    field that named it.
    """

    def __init__(self, backend: Backend, project: str) -> None:
        self._backend = backend
        self._project = project

    def resolve(self, request: AnyRequest) -> Context:
        """Return what the workers need beside the request.

        Returns
        -------
        dict
            ``mesh`` and ``environment``: id, canonical digest, understood; ``brdf``: id, canonical
            digest and spec (the first two None for a BRDF given in the request); ``materials``:
            as much of each one's BRDF, by group; ``lights``, if there are any: what
            ``environment`` holds, ``scale`` and ``rotation_deg`` of each; ``artefacts``: digest,
            job and name by role; ``albedo_texture``: digest or None.  Of a study ``contexts``,
            which differ, and ``points``: of each the place of its context, or why it is refused.
            Of a calibration a ``nonce``, which no other has.
        """
        match request:
            case BakeRequest():
                return self._scene(request)
            case AssetRequest():
                return self._scene(request) | self._lights(request)
            case CompressRequest():
                return {"artefacts": self._artefacts(transfer=request.transfer)}
            case FitLightRequest():
                return self._lights(request)
            case RenderRequest():
                return {"artefacts": self._artefacts(asset=request.asset, light=request.light)}
            case ValidateRequest():
                references = {
                    "asset": request.asset,
                    "transfer": request.transfer,
                    "light": request.light,
                }
                if request.exact is not None:
                    references["exact"] = request.exact
                return {"artefacts": self._artefacts(**references)} | self._lights(request)
            case CalibrateRequest():
                return {"nonce": secrets.randbelow(MOST_NONCE)}
            case StudyRequest():
                return self._study(request)

    def _study(self, request: StudyRequest) -> Context:
        contexts: list[Context] = []
        places: list[Context] = []
        known: dict[str, Context] = {}
        for point in request.points():
            if point.request is None:
                places.append({"refused": point.refused})
                continue
            names = point.request.model_dump(mode="json", exclude=_NAMES_NOTHING)
            key = json.dumps(names, sort_keys=True)
            if key not in known:
                try:
                    contexts.append(self.resolve(point.request))
                except (InputError, NotFound, Conflict) as error:
                    if isinstance(error, InputError) and request.skip_illegal:
                        known[key] = {"refused": error.detail}
                    else:
                        raise type(error)(
                            f"point of {describe(point.values)}: {error.detail}",
                            pointer=f"/base{error.pointer or ''}",
                        ) from error
                else:
                    known[key] = {"context": len(contexts) - 1}
            places.append(known[key])
        if not contexts:
            (reason, *_) = (place["refused"] for place in places)
            raise SettingsError(f"no point can be run: {reason}", pointer="/axes")
        return {"contexts": contexts, "points": places}

    def _scene(self, request: BakeRequest | AssetRequest) -> Context:
        mesh = self._resource("mesh", request.mesh)
        brdf = self._material(request, mesh["understood"])
        groups = [group["name"] for group in mesh["understood"].get("groups", [])]
        require_groups(request.materials, groups)
        materials = {
            name: self._material(material, mesh["understood"], material_pointer(name))
            for name, material in request.materials.items()
        }
        plane = request.receiver
        if plane is not None and plane.albedo_texture is not None:
            own = Material(
                brdf=plane.brdf or LambertSpec(albedo=plane.albedo),
                albedo_texture=plane.albedo_texture,
            )
            self._material(own, {}, "/receiver")
        return {
            "mesh": mesh,
            "brdf": brdf,
            "materials": materials,
            "albedo_texture": request.albedo_texture,
        }

    def _lights(self, request: AssetRequest | FitLightRequest | ValidateRequest) -> Context:
        found: Context = {"environment": self._resource("environment", request.environment)}
        if request.lights:
            found["lights"] = [
                light.model_dump(mode="json", exclude={"environment"})
                | self._resource("environment", light.environment, f"/lights/{place}/environment")
                for place, light in enumerate(request.lights)
            ]
        return found

    def _material(
        self,
        material: Material | BakeRequest | AssetRequest,
        understood: Context,
        pointer: str = "",
    ) -> Context:
        """Resolve a BRDF and check what goes with it; ``pointer`` leads to them.

        A request has the fields of a `Material` too; ``understood`` is that of the mesh.
        """
        if isinstance(material.brdf, str):
            found = self._resource("brdf", material.brdf, f"{pointer}/brdf")
            brdf = found | {"spec": found["understood"].get("spec", found["understood"])}
        else:
            spec = material.brdf.model_dump(mode="json")
            brdf = {"id": None, "canonical": None, "understood": {}, "spec": spec}
        model = brdf["spec"].get("model")
        if material.albedo_texture is not None:
            require_lambert(model, "albedo_texture", pointer)
            _require_uv(understood, "an albedo texture needs", f"{pointer}/albedo_texture")
            self.require_upload(material.albedo_texture, f"{pointer}/albedo_texture")
        if material.tangents == "uv":
            _require_uv(understood, "tangents along u need", f"{pointer}/tangents")
        if material.subsurface is not None:
            require_lambert(model, "subsurface", pointer)
            refuse_two_sided_medium(material.two_sided, pointer)
        if material.vertex_colours:
            require_lambert(model, "vertex_colours", pointer)
            _require_colours(understood, f"{pointer}/vertex_colours")
        return brdf

    def _resource(self, kind: str, resource_id: str, pointer: str | None = None) -> Context:
        pointer = pointer or f"/{kind}"
        if not resource_id.startswith(f"{kind}-"):
            raise NotFound(f"{resource_id} is no {kind}", pointer=pointer)
        try:
            resource = self._backend.resources.get(resource_id, project=self._project)
        except NotFound as error:
            raise NotFound(f"there is no {kind} {resource_id}", pointer=pointer) from error
        if resource.canonical and not self._backend.blobs.exists(resource.canonical):
            raise Conflict(f"the file of {resource.id} is gone: register it again", pointer=pointer)
        return _usable(resource, pointer)

    def _artefacts(self, **references: str) -> dict[str, Context]:
        return {role: self._artefact(role, ref) for role, ref in references.items()}

    def _artefact(self, role: str, reference: str) -> Context:
        pointer = f"/{role}"
        job_id, _, name = reference.partition("/")
        if name not in _FILES[role]:
            fitting = " or ".join(_FILES[role])
            raise InputError(
                f"{name} cannot be the {role}: that is a job's {fitting}", pointer=pointer
            )
        try:
            job = self._backend.jobs.get(job_id, project=self._project)
        except NotFound as error:
            raise NotFound(f"there is no job {job_id}", pointer=pointer) from error
        if job.state is not JobState.succeeded:
            raise Conflict(
                f"job {job_id} is {job.state}: its artefacts can be used once it has succeeded",
                pointer=pointer,
            )
        for artefact in job.artefacts:
            if artefact.name == name:
                return {"digest": artefact.sha256, "job": job_id, "name": name}
        names = ", ".join(artefact.name for artefact in job.artefacts) or "none"
        raise NotFound(f"job {job_id} has no artefact {name} (it has: {names})", pointer=pointer)

    def require_upload(self, digest: str, pointer: str) -> None:
        """Check that the project has uploaded a blob."""
        try:
            self._backend.uploads.get(digest, project=self._project)
        except NotFound as error:
            raise NotFound(f"{digest} has not been uploaded", pointer=pointer) from error


def _require_colours(understood: Context, pointer: str) -> None:
    """Refuse colours that a mesh lacks before the plan would, which may be long after."""
    if not understood.get("vertex_colours"):
        raise SettingsError(
            "the mesh has no usable vertex colours: its warnings say why, if its file holds any",
            pointer=pointer,
        )


def _require_uv(understood: Context, needs: str, pointer: str) -> None:
    """Refuse what needs texture coordinates of a mesh whose registration found none.

    Where it does not say, as of the plane, whoever reads the mesh decides.
    """
    if understood.get("has_uv") is False:
        raise SettingsError(f"{needs} texture coordinates, which the mesh lacks", pointer=pointer)


def _usable(resource: Resource, pointer: str) -> Context:
    if resource.state == "parsing":
        raise Conflict(f"{resource.id} is still being parsed: submit again soon", pointer=pointer)
    if resource.state == "refused":
        why = (resource.problem or {}).get("detail", "see its problem")
        raise Conflict(f"{resource.id} was refused: {why}", pointer=pointer)
    return {
        "id": resource.id,
        "canonical": resource.canonical,
        "understood": resource.understood,
    }
