"""The same place some days later: some objects stand elsewhere, others are gone."""

from dataclasses import replace

import numpy as np

from wearcap.simulation.places.outline import turn
from wearcap.simulation.places.world import World

MOVABLE = (
    "chair",
    "armchair",
    "plant",
    "lamp",
    "board",
    "bin",
    "bench",
    "coffee_table",
    "table",
    "desk",
    "cabinet",
    "sofa",
    "planter",
)


def changed_world(
    world: World, rng: np.random.Generator, moved: float = 0.4, removed: float = 0.15, most_m: float = 0.5
) -> World:
    """The world with these shares of its movable objects shifted (and turned), or removed.

    Walkers keep to the world as it was: objects are moved by at most `most_m`. The capture spots' tables stay.
    """
    vertices, kept = world.mesh.vertices.copy(), np.ones(len(world.mesh.faces), bool)
    objects = list(world.objects)
    for number, item in enumerate(world.objects):
        luck = rng.random()
        shift, angle = rng.uniform(-most_m, most_m, 2) / np.sqrt(2), rng.normal(0.0, 0.4)
        if item.kind not in MOVABLE or luck > moved + removed or _beside_spot(world, item.position):
            continue
        own = world.face_object == number
        if luck < removed:
            kept &= ~own
            continue
        corners, center = np.unique(world.mesh.faces[own]), np.array(item.position[:2])
        about = lambda points: (points - center) @ turn(angle).T + center + shift  # noqa: B023, E731
        vertices[corners, :2] = about(vertices[corners, :2].astype(np.float64))
        place = (*(center + shift).tolist(), item.position[2])
        objects[number] = replace(
            item, footprint=about(item.footprint), position=place, heading=item.heading + float(angle)
        )
    mesh = replace(world.mesh, vertices=vertices, faces=world.mesh.faces[kept])
    return replace(
        world,
        mesh=mesh,
        face_object=world.face_object[kept],
        face_texture=world.face_texture[kept],
        objects=tuple(objects),
    )


def _beside_spot(world: World, position: tuple[float, float, float]) -> bool:
    return any(np.linalg.norm(np.array(position[:2]) - spot.position[:2]) < spot.size for spot in world.spots)
