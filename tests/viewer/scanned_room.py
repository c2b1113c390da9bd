"""The scan of a small room with a door, a sofa and a table, as a scanner on a trolley measures it."""

import numpy as np

from wearcap.scene.scan import Scan
from wearsim.places.builder import WorldBuilder
from wearsim.places.furniture import MAKERS
from wearsim.places.outline import rectangle
from wearsim.places.world import Room
from wearsim.rendering.scan import Scanner, scan_world
from wearsim.rendering.views import Scenery

ROOM = (0.0, 0.0, 4.2, 3.4)
DOOR_X, DOOR_Y = 1.4, 3.4
"""Middle of the door leaf, in the wall at the room's far side; it is 0.86 m wide and 4 cm thick."""
SOFA, CHAIR = (3.0, 0.6, 0.0), (0.7, 0.9, 0.0)
WHITE, LEAF = (0.86, 0.85, 0.82), (0.55, 0.36, 0.2)


def scanned_room(spacing_m: float = 0.04) -> Scan:
    """World axes with x and y along the walls, floor at 0."""
    builder, rng = WorldBuilder("room"), np.random.default_rng(4)
    x0, y0, x1, y1 = ROOM
    outline = rectangle(((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0), 0.0)
    builder.places.rooms.append(Room("room", outline, 0.0))
    builder.add_surface("floor", outline, (0.62, 0.5, 0.38), texture=4.0, thickness=0.1)
    for center, size in (
        (((x0 + x1) / 2, y0 - 0.05, 1.25), (x1 - x0, 0.1, 2.5)),
        ((x0 - 0.05, (y0 + y1) / 2, 1.25), (0.1, y1 - y0, 2.5)),
        ((x1 + 0.05, (y0 + y1) / 2, 1.25), (0.1, y1 - y0, 2.5)),
        ((0.45, y1 + 0.05, 1.25), (0.9, 0.1, 2.5)),
        ((3.05, y1 + 0.05, 1.25), (2.3, 0.1, 2.5)),
        ((DOOR_X, y1 + 0.05, 2.28), (1.0, 0.1, 0.44)),
    ):
        builder.add_block("wall", center, size, WHITE, 2.0)
    builder.add_block("door", (DOOR_X, DOOR_Y, 1.02), (0.86, 0.04, 2.0), LEAF)
    builder.place(MAKERS["sofa"](rng), SOFA, np.pi / 2)
    builder.place(MAKERS["coffee_table"](rng), (2.8, 2.0, 0.0), 0.0)
    builder.place(MAKERS["chair"](rng), CHAIR, 0.6)
    scenery = Scenery.of(builder.finish(cell=0.1))
    return scan_world(scenery, spacing_m, np.random.default_rng(0), Scanner(wrong=0.0, mixed=0.0))
