"""Quick job ``register``: parse an upload in a limited child and store its canonical form."""

from typing import Any

import numpy as np

from prtbake_storage.contract.resources import EnvironmentRegistration, MeshRegistration
from prtbake_storage.hdf5.resources import (
    EnvironmentFile,
    MeshFile,
    write_environment,
    write_mesh,
)
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.procedural import builtin
from prtbake_workers.environment.reading import read_environment
from prtbake_workers.environment.report import light_statistics
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import repair
from prtbake_workers.geometry.teapot import teapot

_MODULE = "prtbake_workers.jobs.register"
MEMORY_BYTES = 6 << 30
CPU_SECONDS = 300
"""What parsing a hostile file may take before its process is ended."""
MAX_SPHERE_SUBDIVISIONS = 6
PARSERS = {
    "mesh": f"{_MODULE}:parse_mesh",
    "environment": f"{_MODULE}:parse_environment",
    "brdf": "prtbake_workers.jobs.register_brdf:parse_brdf",
}


def stages(request: dict[str, Any], _context: dict[str, Any]) -> list[Stage]:
    """Parse in one limited task."""

    def parse(_: Results) -> list[Task]:
        return [
            Task(
                PARSERS[request["resource_kind"]],
                request["registration"],
                label=f"parse {request['resource_kind']}",
                memory_bytes=MEMORY_BYTES,
                cpu_seconds=CPU_SECONDS,
            )
        ]

    return [Stage("parse", "file", 1.0, parse)]


def finish(results: Results) -> Finished:
    """Give what was understood."""
    return Finished(result=results["parse"][0])


def parse_mesh(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: parse and repair a mesh."""
    registration = MeshRegistration.model_validate(args)
    if registration.builtin is not None:
        mesh = _builtin_mesh(registration.builtin.name, registration.builtin.tessellation)
        creased, found = repair(
            RawMesh(
                mesh.positions,
                mesh.faces.astype(np.int64),
                face_groups=None if mesh.face_groups is None else mesh.face_groups.astype(np.int64),
                group_names=mesh.group_names,
            ),
            "builtin",
            orient_outward=False,
            crease_angle_deg=registration.crease_angle_deg,
        )
        if registration.crease_angle_deg is None:
            # stored as it is, with its own exact normals: the teapot's handle touches its body in
            # a point that is no duplicate
            found.n_vertices, found.duplicate_vertices = len(mesh.positions), 0
        else:
            mesh = creased
    else:
        assert registration.blob is not None  # the contract holds exactly one source
        mesh, found = load_mesh(
            context.store.read_bytes(registration.blob),
            registration.format,
            orient_outward=registration.orient_outward,
            crease_angle_deg=registration.crease_angle_deg,
        )
    report = found.to_dict()
    path = context.scratch / "mesh.h5"
    file = MeshFile(
        mesh.positions,
        mesh.faces,
        mesh.normals,
        mesh.uv,
        report,
        mesh.colours,
        mesh.face_groups,
        mesh.group_names,
    )
    write_mesh(path, file)
    return {"understood": report, "canonical": context.store.put_file(path, move=True)}


def _builtin_mesh(name: str, tessellation: int) -> Mesh:
    if name == "teapot":
        return teapot(tessellation)
    return sphere_mesh(min(tessellation, MAX_SPHERE_SUBDIVISIONS))


def parse_environment(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: decode, clean and resample an environment."""
    registration = EnvironmentRegistration.model_validate(args)
    report: dict[str, Any]
    if registration.builtin is not None:
        environment: Environment = builtin(registration.builtin)
        report = {
            "format": "builtin",
            "layout": "lat_long",
            "width": environment.width,
            "height": environment.height,
            "statistics": light_statistics(environment),
        }
    else:
        assert registration.blob is not None  # the contract holds exactly one source
        environment, found = read_environment(
            context.store.read_bytes(registration.blob),
            layout=registration.layout,
            repair_non_finite=registration.repair_non_finite,
            clamp_negative=registration.clamp_negative,
            filename=registration.filename,
            rotation_deg=registration.rotation_deg,
        )
        report = found.to_dict()
    path = context.scratch / "environment.h5"
    write_environment(path, EnvironmentFile(environment.radiance, report))
    return {"understood": report, "canonical": context.store.put_file(path, move=True)}
