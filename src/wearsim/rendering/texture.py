"""Appearance of a simulated world: a material, a seed and a place on its pattern for every face.

Materials follow from the face's object (`WorldObject.kind`), its texture grade, colour and normal; walls stay nearly
blank, which is the hazard of visual localisation. Patterns move with their objects: a moved object looks the same.
"""

import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from wearsim.places.outline import points_in_convex
from wearsim.places.world import World
from wearsim.rendering import texture_kernels as kernels

_TO_LIGHT = np.array((0.35, 0.5, 1.0))
KEY, AMBIENT_BELOW, AMBIENT_ABOVE = 0.26, 0.66, 0.90
LIGHT: Float[np.ndarray, "6"] = np.array([*_TO_LIGHT / np.linalg.norm(_TO_LIGHT), KEY, AMBIENT_BELOW, AMBIENT_ABOVE])
"""Unit direction to the key light, its strength, the ambient light from below and from above."""

_TEXTILE = ("sofa", "armchair", "bed")
_WOODEN = ("table", "desk", "coffee_table", "shelf", "wardrobe", "cabinet", "chair", "bench", "door_frame", "railing")
_STONY = ("low_wall", "planter", "garden_wall")
_LEVEL = (kernels.PARQUET, kernels.TILES, kernels.ASPHALT, kernels.STONE, kernels.CEILING, kernels.CARPET)
_OWN_PICTURE = (kernels.POSTER, kernels.BOOKS, kernels.PAINT)
_PRINTED = 95.0
"""Visual features per m² from which on a face has a print."""


@dataclass(frozen=True, eq=False)
class Paint:
    """Per-face tables that `texture_kernels` reads."""

    frames: Float[np.ndarray, "face 13"]
    """Origin, axes u and v of the pattern, unit normal (world), and the plane's height over the origin (m)."""
    extents: Float[np.ndarray, "face 4"]
    """Range of the face (of the quad that it is half of) along u and v (m)."""
    colors: Float[np.ndarray, "face 3"]
    materials: UInt8[np.ndarray, "face"]
    seeds: Int[np.ndarray, "face"]

    @classmethod
    def of(cls, world: World) -> "Paint":
        """Appearance of a world, the same for the same world."""
        corners = world.mesh.vertices[world.mesh.faces].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
        # origin, heading (rad) and in-plane axes of each face's pattern: its object's own, or the shell's
        edge = world.surfaces[0].polygon[1] - world.surfaces[0].polygon[0]
        places = [(item.position, item.heading) for item in world.objects]
        places.append(((0.0, 0.0, 0.0), float(np.arctan2(edge[1], edge[0]))))
        origin, heading = (np.array(column)[world.face_object] for column in zip(*places))
        u = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], 1)
        along = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(normal))], 1)
        along -= (along * normal).sum(1, keepdims=True) * normal
        u = np.where(np.abs(normal[:, 2:]) > 0.7, along, u)
        u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-20)
        v = np.cross(normal, u)
        offset = corners - origin[:, None]
        a, b = np.einsum("fcx,fx->fc", offset, u), np.einsum("fcx,fx->fc", offset, v)
        extents = np.stack([a.min(1), a.max(1), b.min(1), b.max(1)], 1)
        # The second triangle of a quad gets exactly the extents of the first.
        twin = (np.abs(np.diff(extents, axis=0)) < 1e-3).all(1) & (np.diff(world.face_object) == 0)
        second = np.flatnonzero(twin & ((normal[1:] * normal[:-1]).sum(1) > 0.999)) + 1
        extents[second] = extents[second - 1]
        height = np.einsum("fx,fx->f", offset[:, 0], normal)
        color = world.mesh.color[world.mesh.faces[:, 0]].astype(np.float64)
        materials = _materials(world, corners.mean(1), normal, color, extents)
        # one seed per box side with a picture of its own, per object and side, or per colour of the shell
        names = [zlib.crc32(f"{world.name} {entry.name}".encode()) for entry in world.objects]
        base = np.array([*names, zlib.crc32(world.name.encode())], np.int64)[world.face_object]
        cos, sin = np.cos(heading), np.sin(heading)
        local = np.stack(
            [cos * normal[:, 0] + sin * normal[:, 1], cos * normal[:, 1] - sin * normal[:, 0], normal[:, 2]], 1
        )
        side = np.round(3 * local).astype(np.int64) @ np.array([1009, 9176, 31337])
        tint = np.round(255 * color).astype(np.int64) @ np.array([7, 131, 65537])
        place = np.round(64 * extents).astype(np.int64) @ np.array([73856093, 19349663, 83492791, 5915587])
        level = (world.face_object < 0) & np.isin(materials, _LEVEL)
        seed = base + tint + np.where(level, 0, side) + np.where(np.isin(materials, _OWN_PICTURE), place, 0)
        frames = np.concatenate([origin, u, v, normal, height[:, None]], 1)
        return cls(frames, extents, color, materials, seed & 0x3FFFFFFF)

    @property
    def tables(self) -> tuple[np.ndarray, ...]:
        return self.frames, self.extents, self.colors, self.materials, self.seeds

    def colors_of(
        self,
        points: Float[np.ndarray, "point 3"],
        face: Int[np.ndarray, "point"],
        footprint: Float[np.ndarray, "point"],
    ) -> UInt8[np.ndarray, "point 3"]:
        """Lit colours of points (m) seen from the front of their faces, each averaged over about its footprint (m)."""
        light = np.zeros((len(points), 3), np.float32)
        front = np.ones(len(points), np.float32)
        footprint = footprint.astype(np.float32)
        kernels.color_points(points, face.astype(np.int32), front, footprint, self.tables, LIGHT, light)
        return np.minimum(light, 255).astype(np.uint8)


def _materials(
    world: World,
    middle: Float[np.ndarray, "face 3"],
    normal: Float[np.ndarray, "face 3"],
    color: Float[np.ndarray, "face 3"],
    extents: Float[np.ndarray, "face 4"],
) -> UInt8[np.ndarray, "face"]:
    texture, item = world.face_texture, world.face_object
    red, green, blue = color.T
    green_ish = green > 1.12 * np.maximum(red, blue)
    wood_ish = (red > green) & (green > blue) & (red > 1.22 * blue)
    upright = np.abs(normal[:, 2]) < 0.7
    out = np.where(wood_ish, kernels.WOOD, kernels.PAINT)
    shell = item < 0
    out[shell & (texture <= 1.6)] = kernels.TILES
    out[shell & (texture <= 1.6) & wood_ish] = kernels.PARQUET
    out[shell & (texture == 3.0) & ~wood_ish] = kernels.ASPHALT
    out[shell & np.isin(texture, (5.0, 6.0, 8.0, 12.0)) & ~upright & (normal[:, 2] > 0)] = kernels.STONE
    out[shell & (texture == 0.8)] = kernels.CEILING
    out[shell & (color.min(1) > 0.96)] = kernels.LAMP
    out[texture >= _PRINTED] = kernels.POSTER
    out[shell & (texture == 40.0)] = kernels.CARPET
    kinds = np.array([entry.kind for entry in world.objects] + [""])[item]
    out[np.isin(kinds, ("wall", "pillar")) & ~shell] = kernels.PLASTER
    before = (middle + 0.3 * normal)[:, :2]
    rooms = [] if world.outdoors else [room.polygon for room in world.places.rooms if not room.open_air]
    indoors = np.any([np.zeros(len(before), bool), *(points_in_convex(before, room) for room in rooms)], axis=0)
    out[(kinds == "wall") & upright & ~indoors] = kernels.BRICK
    out[np.isin(kinds, _STONY)] = kernels.BRICK
    out[(kinds == "facade") & (texture == 9.0)] = kernels.BRICK
    out[np.isin(kinds, _WOODEN) & (out != kernels.POSTER) & wood_ish] = kernels.WOOD
    out[(np.isin(kinds, _TEXTILE) | ((kinds == "chair") & (texture == 12.0))) & ~wood_ish] = kernels.FABRIC
    out[(kinds == "shelf") & (out == kernels.POSTER)] = kernels.BOOKS
    small = np.minimum(extents[:, 1] - extents[:, 0], extents[:, 3] - extents[:, 2]) < 0.03
    out[(out == kernels.POSTER) & small] = kernels.PAINT
    printed = np.isin(out, (kernels.POSTER, kernels.BOOKS))
    out[green_ish & ~printed & (texture > 0.9) & ((texture >= 12.0) | shell)] = kernels.FOLIAGE
    return out.astype(np.uint8)
