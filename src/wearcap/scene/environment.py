"""An interactive environment: movable objects, and the object nearest to a hand (thesis §5.2, §5.3)."""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.triangle_distance import BodiesIndex, TriangleIndex
from wearcap.scene.objects import CONTACT_CLASSES, SceneObject


@dataclass(frozen=True)
class Nearest:
    """The object nearest to each of some points of the world."""

    object_index: Int64[Tensor, "query"]
    """Index in `Environment.objects`; -1 where none is within reach."""
    distance: Float[Tensor, "query"]
    """Distance (m) from the point to the object's surface; infinity where none is within reach."""


@dataclass(frozen=True, eq=False)
class Environment:
    """Objects with unique names. Raises WearcapError for repeated names."""

    objects: tuple[SceneObject, ...]

    def __post_init__(self):
        repeated = [name for name, count in Counter(item.name for item in self.objects).items() if count > 1]
        if repeated:
            raise WearcapError(f"several objects are named {repeated[0]!r}", expected="unique names")

    def __len__(self) -> int:
        return len(self.objects)

    def by_name(self, name: str) -> SceneObject:
        """The object of that name. Raises WearcapError where there is none."""
        return self.objects[self.index(name)]

    def index(self, name: str) -> int:
        """Index of the object of that name. Raises WearcapError where there is none."""
        if name not in self._index:
            raise WearcapError(f"no object {name!r}", expected=f"one of {', '.join(self._index) or 'none'}")
        return self._index[name]

    @cached_property
    def _index(self) -> dict[str, int]:
        return {item.name: k for k, item in enumerate(self.objects)}

    @cached_property
    def _shapes(self) -> list[TriangleIndex]:
        """One tree per object; objects of one mesh share it."""
        meshes = {id(item.mesh): item.mesh for item in self.objects}
        built = {key: TriangleIndex.of(mesh) for key, mesh in meshes.items()}
        return [built[id(item.mesh)] for item in self.objects]

    @cached_property
    def _at_rest(self) -> tuple[BodiesIndex, np.ndarray, np.ndarray]:
        """Index of all objects, and their initial rotations and positions in double precision."""
        shapes = {id(shape): shape for shape in self._shapes}
        number = {key: k for k, key in enumerate(shapes)}
        of_body = np.array([number[id(shape)] for shape in self._shapes], np.int64)
        R = np.array([item.R_world_object.tolist() for item in self.objects], np.float64)
        t = np.array([item.t_world_object.tolist() for item in self.objects], np.float64)
        return BodiesIndex.build(list(shapes.values()), of_body), R, t

    def nearest(
        self,
        points_world: Float[Tensor, "query 3"],
        T_world_object: dict[str, Rigid] | None = None,
        contact_class: str | None = None,
        reach_m: float = float("inf"),
    ) -> Nearest:
        """The nearest object to each point, by exact distance to triangles (to points, in a cloud).

        Objects are at `T_world_object` where it names them, else at their initial pose; with a `contact_class` only
        objects of that class count. A point with NaN has no nearest object.
        """
        if contact_class not in (None, *CONTACT_CLASSES):
            raise WearcapError(f"no contact class {contact_class!r}", expected=f"one of {', '.join(CONTACT_CLASSES)}")
        moved = {self.index(name): pose for name, pose in (T_world_object or {}).items()}
        chosen = np.flatnonzero([contact_class in (None, item.freedom.contact_class) for item in self.objects])
        if not len(chosen):
            nothing = torch.full((len(points_world),), -1)
            return Nearest(nothing, torch.full_like(nothing, torch.inf, dtype=points_world.dtype))
        bodies, R, t = self._at_rest
        R, t = R.copy(), t.copy()
        for k, pose in moved.items():
            R[k], t[k] = pose.R.numpy(), pose.t.numpy()
        index, distance = bodies.nearest(
            points_world.double().contiguous().numpy(), chosen, R[chosen], t[chosen], float(reach_m)
        )
        return Nearest(torch.from_numpy(index), torch.from_numpy(distance).to(points_world.dtype))

    def distance(
        self, name: str, points_world: Float[Tensor, "time 3"], T_world_object: Rigid
    ) -> tuple[Float[Tensor, "time"], Float[Tensor, "time 3"]]:
        """Distance (m) of a point to one object over time, and the object's closest point in the world.

        `T_world_object` is the object's pose at each time, or one pose for all. NaN where the point is NaN.
        """
        shape, R, t = self._shapes[self.index(name)], T_world_object.R.double(), T_world_object.t.double()
        local = (R.mT @ (points_world.double() - t)[..., None])[..., 0]
        distance, point = shape.nearest_points(local.contiguous().numpy())
        closest = (R @ torch.from_numpy(point)[..., None])[..., 0] + t
        return torch.from_numpy(distance).to(points_world.dtype), closest.to(points_world.dtype)
