"""The object editor's controls: values are read from them, and changes are written back."""

import numpy as np
import viser

from wearcap.scene.editing import USUAL_KIND
from wearcap.scene.objects import Freedom, SceneObject
from wearcap.scene.scan import Box

TOOLS: tuple[str, ...] = ("look", "box", "brush", "eraser", "hinge / slide", "try")
HINTS = {
    "look": "A click on an object makes it the current one.",
    "box": "A click moves the box there; its arrows move it, the sliders shape it.",
    "brush": "A click selects what is around it; drag the ball to paint on.",
    "eraser": "A click takes away from the selection; drag the ball to go on.",
    "hinge / slide": "Drag the handle of the current object's hinge or arrow, or click where it belongs.",
    "try": "Move the current object as a hand would; it goes back to its place afterwards.",
}
_NONE: str = "none yet"
_NAMES_OF_KINDS = {
    "plane": "slides on the floor",
    "axis": "slides along an axis",
    "hinge": "turns about a hinge",
    "free": "is carried",
}


class SelectPanel:
    """Shape of the box, size of the brush, and name and category of the next object to cut out."""

    def __init__(self, gui: viser.GuiApi):
        self.length = gui.add_slider("Length (m)", 0.02, 6.0, 0.01, 1.0)
        self.width = gui.add_slider("Width (m)", 0.02, 6.0, 0.01, 1.0)
        self.height = gui.add_slider("Height (m)", 0.02, 4.0, 0.01, 1.0)
        self.turn = gui.add_slider("Turn (deg)", -180, 180, 1, 0)
        self.take = gui.add_button("Select what is in the box")
        self.leave = gui.add_button("Deselect what is in the box")
        self.radius = gui.add_slider("Brush (m)", 0.02, 0.6, 0.01, 0.12)
        self.clear = gui.add_button("Clear selection")
        gui.add_divider()
        self.category = gui.add_dropdown("Category", tuple(USUAL_KIND))
        self.name = gui.add_text("Name", "")
        self.cut = gui.add_button("Cut out", color="orange")

    def box(self, center: tuple[float, float, float]) -> Box:
        """Box of this shape at a position."""
        size = (self.length.value, self.width.value, self.height.value)
        return Box(center, size, float(np.deg2rad(self.turn.value)))

    @property
    def shape_sliders(self) -> tuple[viser.GuiSliderHandle, ...]:
        return self.length, self.width, self.height, self.turn


class ObjectPanel:
    """Controls of the current object: its name, its degrees of freedom, its limits, and a slider to try it."""

    def __init__(self, gui: viser.GuiApi):
        self.choice: viser.GuiDropdownHandle[str] = gui.add_dropdown("Object", (_NONE,))
        self.name = gui.add_text("Name", "")
        self.rename = gui.add_button("Rename")
        self.kind = gui.add_dropdown("It", tuple(_NAMES_OF_KINDS.values()))
        self.next_end = gui.add_button("Hinge at another edge")
        self.direction = gui.add_slider("Direction (deg)", -180, 180, 1, 0)
        self.least_deg = gui.add_slider("Least (deg)", -180, 0, 1, 0)
        self.greatest_deg = gui.add_slider("Greatest (deg)", 0, 180, 1, 90)
        self.least_m = gui.add_slider("Least (m)", -2.0, 0.0, 0.01, 0.0)
        self.greatest_m = gui.add_slider("Greatest (m)", 0.0, 2.0, 0.01, 0.4)
        self.try_deg = gui.add_slider("Try (deg)", -180.0, 180.0, 1.0, 0.0)
        self.try_m = gui.add_slider("Try (m)", -2.0, 2.0, 0.01, 0.0)
        self.back = gui.add_button("Put it back")
        self.delete = gui.add_button("Delete", color="red")
        self.show((), None)

    @property
    def current(self) -> str | None:
        return None if self.choice.value == _NONE else self.choice.value

    @property
    def chosen_kind(self) -> str:
        return next(kind for kind, name in _NAMES_OF_KINDS.items() if name == self.kind.value)

    @property
    def limit_sliders(self) -> tuple[viser.GuiSliderHandle, ...]:
        return self.least_deg, self.greatest_deg, self.least_m, self.greatest_m

    def limits(self, kind: str) -> tuple[float, float]:
        """Limits set by the sliders: rad or m."""
        if kind == "hinge":
            return float(np.deg2rad(self.least_deg.value)), float(np.deg2rad(self.greatest_deg.value))
        return float(self.least_m.value), float(self.greatest_m.value)

    def tried(self, kind: str) -> float:
        """Value of the slider: rad or m."""
        return float(np.deg2rad(self.try_deg.value)) if kind == "hinge" else float(self.try_m.value)

    def show(self, items: tuple[SceneObject, ...], current: SceneObject | None) -> None:
        """Show all objects' names, and the current one's properties."""
        names = tuple(item.name for item in items) or (_NONE,)
        if self.choice.options != names:
            self.choice.options = names
        chosen = current.name if current is not None else names[0]
        if self.choice.value != chosen:
            self.choice.value = chosen
        kind = current.freedom.kind if current is not None else None
        for control in (self.name, self.rename, self.kind, self.delete):
            control.visible = current is not None
        for control in (self.next_end, self.least_deg, self.greatest_deg, self.try_deg):
            control.visible = kind == "hinge"
        for control in (self.direction, self.least_m, self.greatest_m, self.try_m):
            control.visible = kind == "axis"
        self.back.visible = current is not None
        if current is None:
            return
        freedom = current.freedom
        _write(self.name, current.name)
        _write(self.kind, _NAMES_OF_KINDS[freedom.kind])
        if freedom.kind == "hinge":
            low, high = np.rad2deg(_limits(freedom, np.pi))
            _write(self.least_deg, round(low))
            _write(self.greatest_deg, round(high))
            self.try_deg.min, self.try_deg.max = float(low), float(max(high, low + 1.0))
        if freedom.axis is not None:
            low, high = _limits(freedom, 2.0)
            _write(self.least_m, round(low, 3))
            _write(self.greatest_m, round(high, 3))
            _write(self.direction, round(float(np.rad2deg(np.arctan2(freedom.axis[1], freedom.axis[0])))))
            self.try_m.min, self.try_m.max = float(low), float(max(high, low + 0.01))


def _limits(freedom: Freedom, widest: float) -> tuple[float, float]:
    return (-widest, widest) if freedom.limits is None else freedom.limits


def _write(control, value) -> None:
    """Set a control's value only if it has changed: a control that is being dragged must not jump."""
    if control.value != value:
        control.value = value
