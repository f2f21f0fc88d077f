import json

import httpx
import pytest

from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import JobError
from support.rows import context_of

LAMBERT = {"model": "lambert", "albedo": [0.8, 0.2, 0.1]}
FILES = {"transfer_h5": b"T", "asset_h5": b"A", "asset-float32_h5": b"E", "light_h5": b"L"}


def test_context_of_an_asset(service: LiveService, http, mesh: str, environment: str) -> None:
    texture = service.backend.blobs.put_bytes(b"a picture")
    service.backend.uploads.add(texture, 9)
    body = {
        "kind": "asset",
        "mesh": mesh,
        "environment": environment,
        "brdf": LAMBERT,
        "albedo_texture": texture,
    }
    job = http.post("/v1/jobs", json=body).json()
    context = context_of(service.backend.database, job["id"])
    named = {"mesh", "environment", "brdf", "materials", "albedo_texture"}
    assert set(context) == named | {"rates"}
    assert context["materials"] == {}
    assert context["mesh"]["id"] == mesh
    assert context["mesh"]["understood"]["n"] == 7
    assert service.backend.blobs.read_bytes(context["mesh"]["canonical"]) == mesh.encode()
    assert context["brdf"]["spec"] == LAMBERT
    assert context["brdf"]["id"] is None
    assert context["albedo_texture"] == texture


def test_context_of_several_lights(service: LiveService, http, environment: str) -> None:
    added = {"environment": environment, "scale": 0.5, "rotation_deg": [0.0, 90.0, 0.0]}
    body = {"kind": "fit_light", "environment": environment, "lights": [added]}
    job = http.post("/v1/jobs", json=body).json()
    context = context_of(service.backend.database, job["id"])
    (light,) = context["lights"]
    assert light["canonical"] == context["environment"]["canonical"]
    assert (light["scale"], light["rotation_deg"]) == (0.5, [0.0, 90.0, 0.0])
    missing = added | {"environment": "environment-00000000000000ff"}
    answer = http.post("/v1/jobs", json=body | {"lights": [added, missing]})
    assert (answer.status_code, answer.json()["pointer"]) == (404, "/lights/1/environment")
    for wrong in ({"scale": 0.0}, {"scale": -1.0}, {"rotation_deg": [0.0]}, {"factor": 2.0}):
        answer = http.post("/v1/jobs", json=body | {"lights": [added | wrong]})
        assert answer.status_code == 422
        assert answer.json()["pointer"].startswith("/lights/0/")


def test_context_of_artefacts(service: LiveService, http, submit) -> None:
    job = submit()
    service.succeed(job["id"], {}, transfer_h5=b"T")
    reference = f"{job['id']}/transfer.h5"
    made = http.post("/v1/jobs", json={"kind": "compress", "transfer": reference}).json()
    context = context_of(service.backend.database, made["id"])
    digest = service.backend.jobs.get(job["id"]).artefacts[0].sha256
    assert context["artefacts"] == {
        "transfer": {"digest": digest, "job": job["id"], "name": "transfer.h5"}
    }
    # nothing was calibrated or learnt
    assert context["rates"] == {"calibration": None, "seconds": None, "factors": {}}


def test_context_of_a_validation(service: LiveService, http, submit, environment: str) -> None:
    job = submit(seed=77)
    service.succeed(job["id"], {}, **FILES)
    files = {role: f"{job['id']}/{role}.h5" for role in ("transfer", "asset", "light")}
    body = {"kind": "validate", "environment": environment} | files
    made = http.post("/v1/jobs", json=body).json()
    assert set(context_of(service.backend.database, made["id"])["artefacts"]) == set(files)
    made = http.post("/v1/jobs", json=body | {"exact": f"{job['id']}/asset-float32.h5"}).json()
    exact = context_of(service.backend.database, made["id"])["artefacts"]["exact"]
    assert service.backend.blobs.read_bytes(exact["digest"]) == b"E"


def test_repeating_a_submission_needs_no_reference(service: LiveService, http, submit) -> None:
    made = submit()
    service.succeed(made["id"], {}, transfer_h5=b"T")
    body = {"kind": "compress", "transfer": f"{made['id']}/transfer.h5"}

    def by_key(body: dict[str, object]) -> httpx.Response:
        return http.post("/v1/jobs", json=body, headers={"Idempotency-Key": "outlives"})

    def by_id(body: dict[str, object]) -> httpx.Response:
        return http.put("/v1/jobs/outlives", json=body)

    first = {send: send(body).json()["id"] for send in (by_key, by_id)}
    assert http.delete(f"/v1/jobs/{made['id']}").status_code == 204
    for send, job in first.items():
        again = send(body)
        assert (again.status_code, again.json()["id"]) == (200, job)
        assert send(body | {"seed": 1}).status_code == 409
    assert http.post("/v1/jobs", json=body).status_code == 404  # a new one does


@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"mesh": "mesh-00000000000000ff"}, "/mesh"),
        ({"environment": "environment-00000000000000ff"}, "/environment"),
        ({"brdf": "brdf-00000000000000ff"}, "/brdf"),
        ({"albedo_texture": "sha256:" + "1" * 64}, "/albedo_texture"),
        ({"mesh": "environment-00000000000000ff"}, "/mesh"),
    ],
)
def test_what_is_not_there_is_404_with_a_pointer(
    http: httpx.Client, mesh: str, environment: str, change: dict[str, str], pointer: str
) -> None:
    body = {"kind": "asset", "mesh": mesh, "environment": environment, "brdf": LAMBERT} | change
    for path in ("/v1/jobs", "/v1/jobs:estimate"):
        answer = http.post(path, json=body)
        assert answer.status_code == 404
        assert answer.json()["pointer"] == pointer


@pytest.mark.parametrize(
    ("role", "wrong"),
    [
        ("transfer", "light.h5"),
        ("asset", "transfer.h5"),
        ("exact", "asset.h5"),
        ("light", "asset-float32.h5"),
    ],
)
def test_an_artefact_of_another_kind_is_refused(
    service: LiveService, http, submit, environment: str, role: str, wrong: str
) -> None:
    """At submission, where it is seen, and not by the job that cannot read it."""
    job = submit(seed=78)
    service.succeed(job["id"], {}, **FILES)
    files = {name: f"{job['id']}/{name}.h5" for name in ("transfer", "asset", "light")}
    body = {"kind": "validate", "environment": environment} | files
    for path in ("/v1/jobs", "/v1/jobs:estimate"):
        answer = http.post(path, json=body | {role: f"{job['id']}/{wrong}"})
        assert (answer.status_code, answer.json()["pointer"]) == (400, f"/{role}")
        assert wrong in answer.json()["detail"]


@pytest.mark.parametrize(
    ("tessellation", "understood", "model", "why"),
    [
        (21, {"vertex_colours": True}, "lambert", None),
        (22, {"vertex_colours": True}, "ggx", "lambert"),
        (23, {"vertex_colours": False}, "lambert", "no usable vertex colours"),
        # parsed before colours were read
        (24, {}, "lambert", "no usable vertex colours"),
    ],
)
def test_vertex_colours_need_a_coloured_mesh_and_a_lambert_brdf(
    service: LiveService,
    http,
    tessellation: int,
    understood: dict[str, bool],
    model: str,
    why: str | None,
) -> None:
    # a mesh of its own: what is registered twice is the same resource
    body = {"builtin": {"name": "teapot", "tessellation": tessellation}}
    made = http.post("/v1/meshes", json=body).json()
    canonical = service.backend.blobs.put_bytes(b"a coloured mesh")
    service.succeed(f"parse-{made['id']}", {"canonical": canonical, "understood": understood})
    body = {"kind": "bake", "mesh": made["id"], "brdf": {"model": model}}
    answer = http.post("/v1/jobs", json=body | {"vertex_colours": True})
    if why is None:
        assert answer.status_code == 202, answer.text
        assert answer.json()["request"]["vertex_colours"] is True
        return
    assert (answer.status_code, answer.json()["pointer"]) == (400, "/vertex_colours")
    assert why in answer.json()["detail"]
    # it is the colours that are refused
    assert http.post("/v1/jobs", json=body).status_code == 202


@pytest.mark.parametrize(("tessellation", "has_uv"), [(31, True), (32, False), (33, None)])
@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"tangents": "uv"}, "/tangents"),
        ({"albedo_texture": "TEXTURE"}, "/albedo_texture"),
        ({"materials": {"lid": {"brdf": LAMBERT, "tangents": "uv"}}}, "/materials/lid/tangents"),
        ({"materials": {"lid": {"brdf": LAMBERT, "albedo_texture": "TEXTURE"}}},
         "/materials/lid/albedo_texture"),
        ({"tangents": [0.0, 1.0, 0.0], "receiver": {"albedo_texture": "TEXTURE"}}, None),
    ],
)  # fmt: skip
def test_what_needs_texture_coordinates_is_refused_without_them(
    service: LiveService, http, tessellation: int, has_uv: bool | None,
    change: dict[str, object], pointer: str | None,
) -> None:  # fmt: skip
    """At submission, since registration knows; a plane has coordinates of its own."""
    texture = service.backend.blobs.put_bytes(b"a fourth picture")
    service.backend.uploads.add(texture, 16)
    body = {"builtin": {"name": "teapot", "tessellation": tessellation}}
    made = http.post("/v1/meshes", json=body).json()
    if made["state"] == "parsing":
        canonical = service.backend.blobs.put_bytes(b"a mesh")
        understood = {"groups": GROUPS} | ({} if has_uv is None else {"has_uv": has_uv})
        result = {"canonical": canonical, "understood": understood}
        service.succeed(f"parse-{made['id']}", result)
    change = json.loads(json.dumps(change).replace("TEXTURE", texture))
    body = {"kind": "bake", "mesh": made["id"], "brdf": LAMBERT} | change
    for path in ("jobs:estimate", "jobs"):
        answer = http.post(f"/v1/{path}", json=body)
        if has_uv is False and pointer is not None:
            assert (answer.status_code, answer.json()["pointer"]) == (400, pointer)
            assert "texture coordinates, which the mesh lacks" in answer.json()["detail"]
        else:
            assert answer.status_code == 202, answer.text


@pytest.mark.parametrize("registered", [False, True])
@pytest.mark.parametrize("model", ["lambert", "ggx"])
def test_a_texture_needs_a_lambert_brdf(
    service: LiveService, http, mesh: str, model: str, registered: bool
) -> None:
    texture = service.backend.blobs.put_bytes(b"another picture")
    service.backend.uploads.add(texture, 15)
    brdf: object = {"model": model}
    if registered:
        made = http.post("/v1/brdfs", json={"spec": brdf}).json()
        result = {"canonical": texture, "understood": {"spec": made["request"]["spec"]}}
        service.succeed(f"parse-{made['id']}", result)
        brdf = made["id"]
    body = {"kind": "bake", "mesh": mesh, "brdf": brdf, "albedo_texture": texture}
    answer = http.post("/v1/jobs", json=body)
    if model == "lambert":
        assert answer.status_code == 202
    else:
        assert (answer.status_code, answer.json()["pointer"]) == (400, "/albedo_texture")
        assert "lambert" in answer.json()["detail"]


MARBLE = {"medium": "marble", "mm_per_unit": 10.0}


def test_a_medium_needs_a_lambert_brdf(http: httpx.Client, mesh: str) -> None:
    for model, status in (("lambert", 202), ("ggx", 400)):
        body = {"kind": "bake", "mesh": mesh, "brdf": {"model": model}, "subsurface": MARBLE}
        for path in ("/v1/jobs", "/v1/jobs:estimate"):
            answer = http.post(path, json=body)
            assert answer.status_code == status
        if status == 400:
            assert answer.json()["pointer"] == "/subsurface"
            assert "lambert" in answer.json()["detail"]


@pytest.mark.parametrize(
    "medium",
    [
        {"mm_per_unit": 1.0},
        {"medium": "granite", "mm_per_unit": 1.0},
        {"scattering": 1.0, "mm_per_unit": 1.0},
        {"scattering": [1.0, 0.0, 1.0], "absorption": 0.0, "mm_per_unit": 1.0},
        MARBLE | {"eta": 1.4},
        MARBLE | {"mm_per_unit": 0.0},
    ],
)
def test_a_medium_that_means_nothing_is_refused(
    http: httpx.Client, mesh: str, medium: dict[str, object]
) -> None:
    body = {"kind": "bake", "mesh": mesh, "brdf": LAMBERT, "subsurface": medium}
    answer = http.post("/v1/jobs", json=body)
    assert answer.status_code == 422
    assert answer.json()["pointer"].startswith("/subsurface")


GROUPS = [{"name": "lid", "faces": 3}, {"name": "a/b~c", "faces": 9}]


@pytest.fixture
def grouped(service: LiveService, http: httpx.Client) -> str:
    """A ready mesh with two groups of faces."""
    made = http.post("/v1/meshes", json={"builtin": {"name": "teapot", "tessellation": 7}}).json()
    canonical = service.backend.blobs.put_bytes(b"grouped")
    if made["state"] == "parsing":
        service.succeed(
            f"parse-{made['id']}", {"canonical": canonical, "understood": {"groups": GROUPS}}
        )
    return str(made["id"])


def test_context_of_materials(service: LiveService, http: httpx.Client, grouped: str) -> None:
    """Every material's BRDF is resolved, and what names a blob is kept for the job."""
    texture = service.backend.blobs.put_bytes(b"a third picture")
    service.backend.uploads.add(texture, 15)
    spec = {"model": "ggx", "alpha": 0.2831}
    made = http.post("/v1/brdfs", json={"spec": spec}).json()
    canonical = service.backend.blobs.put_bytes(b"shiny")
    understood = {"spec": made["request"]["spec"], "isotropic": True}
    service.succeed(f"parse-{made['id']}", {"canonical": canonical, "understood": understood})
    body = {
        "kind": "bake", "mesh": grouped, "brdf": LAMBERT,
        "materials": {
            "lid": {"brdf": made["id"]}, "a/b~c": {"brdf": LAMBERT, "albedo_texture": texture}
        },
        "receiver": {"albedo_texture": texture},
    }  # fmt: skip
    job = http.post("/v1/jobs", json=body)
    assert job.status_code == 202, job.text
    found = context_of(service.backend.database, job.json()["id"])["materials"]
    assert found["lid"]["id"] == made["id"]
    assert found["lid"]["spec"] == understood["spec"]
    assert found["a/b~c"]["spec"] == LAMBERT
    assert job.json()["request"]["materials"]["a/b~c"]["albedo_texture"] == texture


TEXTURE = {"albedo_texture": "sha256:" + "2" * 64}


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs:estimate"])
@pytest.mark.parametrize(
    ("change", "status", "pointer", "detail"),
    [
        ({"materials": {"lib": {"brdf": LAMBERT}}}, 400, "/materials/lib", "'lid', 'a/b~c'"),
        ({"materials": {"x/~": {"brdf": LAMBERT}}}, 400, "/materials/x~1~0", "no group of faces"),
        ({"materials": {"a/b~c": {"brdf": "brdf-00000000000000ff"}}}, 404,
         "/materials/a~1b~0c/brdf", "there is no brdf"),
        ({"materials": {"lid": {"brdf": LAMBERT} | TEXTURE}}, 404,
         "/materials/lid/albedo_texture", "has not been uploaded"),
        ({"materials": {"lid": {"brdf": {"model": "ggx"}} | TEXTURE}}, 400,
         "/materials/lid/albedo_texture", "needs a lambert"),
        ({"receiver": TEXTURE}, 404, "/receiver/albedo_texture", "has not been uploaded"),
        ({"receiver": {"brdf": {"model": "ggx"}} | TEXTURE}, 400, "/receiver/albedo_texture",
         "needs a lambert"),
        ({"materials": {"lid": {"brdf": {"model": "ggx"}, "subsurface": MARBLE}}}, 400,
         "/materials/lid/subsurface", "needs a lambert"),
        ({"subsurface": MARBLE, "two_sided": True}, 400, "/two_sided", "needs an inside"),
        ({"materials": {"lid": {"brdf": LAMBERT, "subsurface": MARBLE, "two_sided": True}}}, 400,
         "/materials/lid/two_sided", "needs an inside"),
        ({"materials": {"lid": {"brdf": LAMBERT, "two_sided": "maybe"}}}, 422,
         "/materials/lid/two_sided", "valid boolean"),
        ({"materials": {"lid": {"brdf": LAMBERT, "vertex_colours": True}}}, 400,
         "/materials/lid/vertex_colours", "no usable vertex colours"),
        ({"materials": {"lid": {}}}, 422, "/materials/lid/brdf", "required"),
        ({"materials": {"a/b~c": {"brdf": LAMBERT, "roughness": 1}}}, 422,
         "/materials/a~1b~0c/roughness", "Extra inputs"),
        ({"materials": {f"g{i}": {"brdf": LAMBERT} for i in range(33)}}, 422, "/materials",
         "at most 32"),
        ({"receiver": {"texture_repeats": 0}}, 422, "/receiver/texture_repeats", "greater than 0"),
    ],
)  # fmt: skip
def test_a_material_that_cannot_be_is_refused_where_it_stands(
    http: httpx.Client, grouped: str, path: str, change: dict[str, object], status: int,
    pointer: str, detail: str,
) -> None:  # fmt: skip
    answer = http.post(path, json={"kind": "bake", "mesh": grouped, "brdf": LAMBERT} | change)
    assert (answer.status_code, answer.json()["pointer"]) == (status, pointer), answer.text
    assert detail in answer.text


def test_a_mesh_without_groups_takes_no_materials(http: httpx.Client, mesh: str) -> None:
    body = {"kind": "bake", "mesh": mesh, "brdf": LAMBERT, "materials": {"a": {"brdf": LAMBERT}}}
    answer = http.post("/v1/jobs", json=body)
    assert (answer.status_code, answer.json()["pointer"]) == (400, "/materials/a")
    assert "it has none at all" in answer.json()["detail"]


def test_an_artefact_must_be_finished(service: LiveService, http, submit) -> None:
    job = submit()
    body = {"kind": "compress", "transfer": f"{job['id']}/transfer.h5"}
    answer = http.post("/v1/jobs", json=body)
    assert (answer.status_code, answer.json()["pointer"]) == (409, "/transfer")
    service.succeed(job["id"], {}, other_h5=b"")
    answer = http.post("/v1/jobs", json=body)
    assert (answer.status_code, answer.json()["pointer"]) == (404, "/transfer")
    assert "other.h5" in answer.json()["detail"]


def test_a_resource_must_be_parsed(service: LiveService, http, mesh: str) -> None:
    made = http.post("/v1/environments", json={"builtin": {"name": "hall", "width": 16}}).json()
    body = {"kind": "fit_light", "environment": made["id"]}
    answer = http.post("/v1/jobs", json=body)
    assert (answer.status_code, answer.json()["pointer"]) == (409, "/environment")
    error = JobError(kind="input", code="invalid-environment", detail="pixel (3, 4) is NaN")
    service.fail(f"parse-{made['id']}", error)
    answer = http.post("/v1/jobs", json=body)
    assert answer.status_code == 409
    assert "pixel (3, 4) is NaN" in answer.json()["detail"]


BRUSHED = {"model": "ward", "alpha_x": 0.1, "alpha_y": 0.3}
LOBES = {"model": "lafortune", "lobes": [{"cx": -1.0, "cy": -0.5}]}


@pytest.mark.parametrize("tangents", ["horizontal", "uv", [0.0, 1.0, -2.0]])
@pytest.mark.parametrize("brdf", [BRUSHED, LOBES])
def test_an_anisotropic_brdf_is_taken_with_its_tangents(
    http, mesh: str, brdf: dict[str, object], tangents: object
) -> None:
    body = {"kind": "bake", "mesh": mesh, "brdf": brdf, "tangents": tangents}
    answer = http.post("/v1/jobs", json=body | {"receiver": {"brdf": BRUSHED}})
    assert answer.status_code == 202
    assert answer.json()["request"]["tangents"] == tangents


@pytest.mark.parametrize("tangents", ["vertical", [0.0, 1.0], [0.0, 0.0, 0.0]])
def test_tangents_must_point_somewhere(http, mesh: str, tangents: object) -> None:
    body = {"kind": "bake", "mesh": mesh, "brdf": BRUSHED, "tangents": tangents}
    answer = http.post("/v1/jobs", json=body)
    assert answer.status_code == 422
    assert answer.json()["pointer"].startswith("/tangents")


@pytest.mark.parametrize("isotropic", [True, False])
def test_a_registered_brdf_is_taken_whatever_was_understood_of_its_grain(
    service: LiveService, http, mesh: str, isotropic: bool
) -> None:
    spec = BRUSHED | {"alpha_y": 0.1 if isotropic else 0.3}
    made = http.post("/v1/brdfs", json={"spec": spec}).json()
    canonical = service.backend.blobs.put_bytes(b"brushed")
    understood = {"spec": spec, "isotropic": isotropic}
    service.succeed(f"parse-{made['id']}", {"canonical": canonical, "understood": understood})
    answer = http.post("/v1/jobs", json={"kind": "bake", "mesh": mesh, "brdf": made["id"]})
    assert answer.status_code == 202
    assert context_of(service.backend.database, answer.json()["id"])["brdf"]["spec"] == spec


def test_a_resource_of_another_kind_is_named(http, mesh: str) -> None:
    answer = http.post("/v1/jobs", json={"kind": "fit_light", "environment": mesh})
    assert answer.json()["detail"] == f"{mesh} is no environment"
