"""Walkable floor and the paths between two places: a layered height grid and shortest paths over it.

Each storey is a layer of cells with the height of its floor. Neighbouring cells whose heights differ by no more
than a step are linked, within a layer and between layers, so stairs, ramps and kerbs need no special case.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.csgraph
from jaxtyping import Bool, Float, Int

from wearsim.places.outline import distance_to_convex, points_in_convex

STEP_M = 0.25
"""Neighbouring cells are linked up to this difference in height: one stair's rise, but not two."""
DROP_M = 0.45
"""Depth from which on a hole, or the edge of the world, is an obstacle like a wall."""
HEADROOM_M = 1.9
LOW_M = 0.1
"""Height above the floor below which objects are no obstacles (a rug, a kerb)."""
CLEARANCE_M = 0.28
FAR_M = 1.5
"""Largest clearance that is measured."""
SNAP_M = 1.5
"""Largest distance of a start or goal from the nearest walkable cell."""
WAYPOINT_M, SMOOTHING_PASSES = 0.1, 80
STAIR_APPROACH_M = 0.5
"""Distance from stairs within which paths are straight."""

_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))


@dataclass(frozen=True)
class NavigationGrid:
    """Cell (i, j) of a layer covers origin + cell · [(i, i + 1), (j, j + 1)]; arrays are "layer i j"."""

    origin: Float[np.ndarray, "2"]
    cell: float
    height: Float[np.ndarray, "layer i j"]
    """Floor height at the cell's middle (m); NaN where the layer has none."""
    clearance: Float[np.ndarray, "layer i j"]
    """Distance from the cell's middle to the nearest obstacle or drop (m)."""
    walkable: Bool[np.ndarray, "layer i j"]
    """Cells of the largest connected part in which the middle of a walker may be."""

    @classmethod
    def build(cls, surfaces: tuple, objects: tuple, cell: float) -> "NavigationGrid":
        """Rasterise the surfaces and measure the distance of each cell from the objects that block it."""
        corners = np.concatenate([surface.polygon for surface in surfaces])
        origin = corners.min(0) - cell
        shape = tuple(np.ceil((corners.max(0) + cell - origin) / cell).astype(int))
        middles = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) * cell + origin + cell / 2
        height = np.full((1 + max(surface.level for surface in surfaces), *shape), np.nan)
        for surface in surfaces:
            window = _window(surface.polygon, origin, cell, shape, 0.0)
            inside = points_in_convex(middles[window].reshape(-1, 2), surface.polygon)
            inside = inside.reshape(middles[window].shape[:-1])
            layer = height[surface.level][window]
            layer[inside] = np.fmax(layer[inside], surface.height(middles[window][inside]))
        drop = np.zeros_like(height)  # distance (m) from where a layer ends with no other layer near that height
        for layer, floor in enumerate(height):
            void = np.isnan(floor)
            if not void.any():
                drop[layer] = FAR_M
                continue
            nearest = scipy.ndimage.distance_transform_edt(void, return_distances=False, return_indices=True)
            gap = np.abs(height - floor[tuple(nearest)])
            deep = void & ~(np.nan_to_num(gap, nan=np.inf).min(0) < DROP_M)
            away = np.asarray(scipy.ndimage.distance_transform_edt(~np.pad(deep, 1, constant_values=True)))
            drop[layer] = (away[1:-1, 1:-1] - 0.5) * cell
        clearance = np.minimum(np.maximum(drop, 0.0), FAR_M)
        _keep_off(objects, origin, cell, height, clearance)
        free = np.isfinite(height) & (clearance >= CLEARANCE_M)
        part = _parts(height, free)
        walkable = part == np.bincount(part[part >= 0], minlength=1).argmax()
        return cls(origin, cell, height, clearance, walkable)

    def barred(self, objects: tuple, around: Float[np.ndarray, "3"]) -> "NavigationGrid":
        """The grid with additional obstacles, walkable where one gets to from a floor point (m)."""
        clearance = self.clearance.copy()
        _keep_off(objects, self.origin, self.cell, self.height, clearance)
        free = np.isfinite(self.height) & (clearance >= CLEARANCE_M)
        cells = np.argwhere(free)
        middles = self.origin + (cells[:, 1:] + 0.5) * self.cell
        offset = np.linalg.norm(middles - around[:2], axis=1)
        offset += np.where(np.abs(self.height[free] - around[2]) < 0.6, 0.0, np.inf)
        part = _parts(self.height, free)
        walkable = part == part[tuple(cells[offset.argmin()])] if len(cells) else free
        return NavigationGrid(self.origin, self.cell, self.height, clearance, walkable)

    @cached_property
    def _graph(self) -> tuple[scipy.sparse.csr_array, np.ndarray, np.ndarray]:
        """Links with their lengths (m, climbs included), and the two nodes of each link in the matrix's order."""
        first, second = _links(self.height, self.walkable)
        nodes = np.cumsum(self.walkable) - 1  # the numbers of walkable cells
        a, b = nodes[first], nodes[second]
        step = self.node_points[a] - self.node_points[b]
        length = np.linalg.norm(step, axis=1) + 1e-6
        size = int(self.walkable.sum())
        both = (np.concatenate([length, length]), (np.concatenate([a, b]), np.concatenate([b, a])))
        graph = scipy.sparse.csr_array(scipy.sparse.coo_array(both, shape=(size, size)))
        source = np.repeat(np.arange(size), np.diff(graph.indptr))
        return graph, source, graph.indices

    @cached_property
    def node_points(self) -> Float[np.ndarray, "node 3"]:
        xy = self.origin + (np.argwhere(self.walkable)[:, 1:] + 0.5) * self.cell
        return np.concatenate([xy, self.height[self.walkable][:, None]], 1)

    def layer_of(self, points: Float[np.ndarray, "*batch 3"]) -> Int[np.ndarray, "*batch"]:
        """Index of the layer whose floor is nearest in height to each point."""
        index = np.floor((points[..., :2] - self.origin) / self.cell).astype(int)
        i, j = np.moveaxis(np.clip(index, 0, np.array(self.height.shape[1:]) - 1), -1, 0)
        gap = np.abs(self.height[:, i, j] - points[..., 2])
        return np.where(np.isnan(gap), np.inf, gap).argmin(0)

    def clearance_at(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Distance from floor points to the nearest obstacle or drop (m), bilinear between cells."""
        return self.clearance_in(self.layer_of(points), points[..., :2])

    def clearance_in(self, layer: np.ndarray, points_xy: np.ndarray) -> np.ndarray:
        """`clearance_at` for points (x y) of known layers."""
        place = (points_xy - self.origin) / self.cell - 0.5
        low = np.clip(np.floor(place).astype(int), 0, np.array(self.height.shape[1:]) - 2)
        u, v = np.moveaxis(np.clip(place - low, 0.0, 1.0), -1, 0)
        i, j = np.moveaxis(low, -1, 0)
        near = (1 - v) * self.clearance[layer, i, j] + v * self.clearance[layer, i, j + 1]
        far = (1 - v) * self.clearance[layer, i + 1, j] + v * self.clearance[layer, i + 1, j + 1]
        return (1 - u) * near + u * far

    def nearest_node(self, point: Float[np.ndarray, "3"]) -> int | None:
        """The walkable cell nearest to a floor point, within 1.5 m and on its storey; None when there is none."""
        offset = self.node_points - point
        distance = np.linalg.norm(offset[:, :2], axis=1) + np.where(np.abs(offset[:, 2]) < 0.6, 0.0, np.inf)
        nearest = int(distance.argmin())
        return nearest if distance[nearest] < SNAP_M else None

    def lengths_from(self, start: Float[np.ndarray, "3"]) -> Float[np.ndarray, "node"]:
        """Length (m) of the shortest path from a floor point to every walkable cell (`node_points`)."""
        first = self.nearest_node(start)
        if first is None:
            return np.full(len(self.node_points), np.inf)
        return scipy.sparse.csgraph.dijkstra(self._graph[0], indices=first)

    def shortest(
        self, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"], shyness: float
    ) -> Float[np.ndarray, "point 3"] | None:
        """Middles of the cells on the cheapest path; a metre at the least clearance costs 1 + `shyness`."""
        first, last = self.nearest_node(start), self.nearest_node(goal)
        if first is None or last is None:
            return None
        graph, source, target = self._graph
        price = 1 + shyness * np.exp(-(self.clearance[self.walkable] - CLEARANCE_M) / 0.15)
        weights = graph.data * (price[source] + price[target]) / 2
        priced = scipy.sparse.csr_array((weights, graph.indices, graph.indptr), shape=graph.shape)
        _, came_from = scipy.sparse.csgraph.dijkstra(priced, indices=last, return_predecessors=True)
        path = [first]
        while path[-1] != last:
            path.append(int(came_from[path[-1]]))
        return self.node_points[path]

    def path(
        self, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"], flights: list, rng: np.random.Generator
    ) -> Float[np.ndarray, "waypoint 3"] | None:
        """A smooth path off obstacles, straight on `flights`, waypoints about 0.1 m apart; heights only to a cell."""
        cells = self.shortest(start, goal, shyness=rng.uniform(1.0, 4.0))
        if cells is None:
            return None
        points = _evenly(np.concatenate([start[None], cells, goal[None]]))
        if len(points) < 4:
            return points
        layer = self.layer_of(points)
        sides = [rng.uniform(-1, 1) * max(flight.width / 2 - 0.35, 0.0) for flight in flights]
        for _ in range(SMOOTHING_PASSES):
            moved = points.copy()
            moved[1:-1, :2] += 0.5 * ((points[:-2, :2] + points[2:, :2]) / 2 - points[1:-1, :2])
            for flight, side in zip(flights, sides):  # drawn to a line beside the flight's middle
                run, off = flight.up_and_left(moved[:, :2])
                on = (run > -STAIR_APPROACH_M) & (run < flight.length + STAIR_APPROACH_M)
                on &= (np.abs(off) < flight.width / 2) & (moved[:, 2] > flight.base_z - 0.3)
                on &= moved[:, 2] < flight.top_z + 0.3
                on[[0, -1]] = False
                moved[on, :2] += ((side - off[on]) * 0.5)[:, None] * flight.left
            clear = self.clearance_in(layer, moved[:, :2])
            tight = (clear < CLEARANCE_M) & (clear < self.clearance_in(layer, points[:, :2]))
            points = np.where(tight[:, None], points, moved)
        return _evenly(points)


def _window(outline: np.ndarray, origin: np.ndarray, cell: float, shape: tuple, margin: float) -> tuple:
    low = np.floor((outline.min(0) - margin - origin) / cell).astype(int)
    high = np.ceil((outline.max(0) + margin - origin) / cell).astype(int) + 1
    # Outside the grid nothing is left: a negative end would count from the other side.
    return tuple(slice(max(a, 0), max(min(b, size), 0)) for a, b, size in zip(low, high, shape))


def _links(height: np.ndarray, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of linked pairs of cells: neighbours of any two layers that a step separates."""
    index = np.arange(height.size).reshape(height.shape)
    pairs = []
    for di, dj in _NEIGHBOURS:
        here = (slice(0, -di or None), slice(max(-dj, 0), -dj if dj > 0 else None))
        there = (slice(di, None), slice(max(dj, 0), dj if dj < 0 else None))
        for a in range(len(height)):
            for b in range(len(height)):
                near = np.abs(height[a][here] - height[b][there]) <= STEP_M
                near &= allowed[a][here] & allowed[b][there]
                pairs.append((index[a][here][near], index[b][there][near]))
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])


def _parts(height: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Numbers of the connected parts of the free cells; -1 elsewhere."""
    first, second = _links(height, free)
    graph = scipy.sparse.coo_array((np.ones(len(first)), (first, second)), shape=(free.size, free.size))
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return np.where(free, part.reshape(free.shape), -1)


def _keep_off(objects: tuple, origin: np.ndarray, cell: float, height: np.ndarray, clearance: np.ndarray) -> None:
    """Lower, in place, the clearance of the cells about objects to the distance from them."""
    shape = height.shape[1:]
    for item in objects:
        window = _window(item.footprint, origin, cell, shape, FAR_M)
        i, j = (np.arange(part.start, part.stop) for part in window)
        middles = np.stack(np.meshgrid(i, j, indexing="ij"), -1) * cell + origin + cell / 2
        distance = distance_to_convex(middles, item.footprint)
        for floor, clear in zip(height, clearance):
            bars = (item.z_range[0] < floor[window] + HEADROOM_M) & (item.z_range[1] > floor[window] + LOW_M)
            clear[window] = np.where(bars, np.minimum(clear[window], distance), clear[window])


def _evenly(points: np.ndarray) -> np.ndarray:
    """The same polyline with waypoints spaced evenly in the plane, both ends kept."""
    length = np.concatenate([[0.0], np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).cumsum()])
    count = max(int(np.ceil(length[-1] / WAYPOINT_M)), 1) + 1
    place = np.linspace(0.0, length[-1], count)
    return np.stack([np.interp(place, length, axis) for axis in points.T], 1)
