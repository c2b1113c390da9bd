"""Habits that make one person's movement their own, drawn once per person, varied a little per recording."""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Style:
    """Habits of gait and posture. Lengths in m, angles in rad; typical adults' means and deviations."""

    speed: float = 1.25
    """Preferred walking speed (m/s)."""
    walk_ratio: float = 0.0065
    """Step length per cadence (m per step/min), for a leg of 0.93 m; grows with the leg's length."""
    step_width: float = 0.10
    stance_width: float = 0.19
    toe_out: float = 0.12
    variability: float = 0.03
    """Deviation of step length, time and width from step to step, as a share."""
    knee_soft: float = 0.14
    """Knee flexion at which the standing leg counts as straight."""
    heel_rise: float = 1.0
    """Scales how far feet roll at push-off and landing."""
    arm_swing: float = 0.46
    """Shoulder angle per metre between the feet (rad/m)."""
    arm_symmetry: float = 0.0
    """More swing left than right, as a share."""
    elbow: float = 0.30
    arm_spread: float = 0.14
    arm_turn: float = 0.32
    """Inward turn of the hanging arm: palms face back."""
    slouch: float = 0.05
    """Forward lean of the chest."""
    head_pitch: float = 0.12
    """Habitual downward tilt of the head while walking."""
    pelvis_tilt: float = 0.07
    pelvis_yaw: float = 0.12
    """Turn per metre between the feet (rad/m)."""
    pelvis_list: float = 0.06
    trunk_counter: float = 1.1
    """Trunk turn against the pelvis, as a share of the pelvis' turn."""
    sway: float = 0.005
    """Standing sway (m)."""
    briskness: float = 1.0
    """Scales the tempo of everything that is not walking."""

    @classmethod
    def sample(cls, rng: np.random.Generator, leg_length: float = 0.93) -> "Style":
        """A person drawn at random; `leg_length` is the hips' height above the floor (m)."""
        base = cls()
        draw = {
            "speed": rng.normal(1.25, 0.13) * (leg_length / 0.93) ** 0.5,
            "walk_ratio": rng.normal(0.0065, 0.0005) * leg_length / 0.93,
            "step_width": rng.normal(0.10, 0.02),
            "stance_width": rng.normal(0.19, 0.035),
            "toe_out": rng.normal(0.12, 0.07),
            "arm_symmetry": rng.normal(0.0, 0.15),
            "slouch": rng.normal(0.05, 0.05),
            "head_pitch": rng.normal(0.12, 0.07),
        }
        for name in (f.name for f in fields(cls) if f.name not in draw):
            draw[name] = getattr(base, name) * float(np.exp(rng.normal(0.0, 0.22)))
        draw["heel_rise"] = float(np.clip(rng.normal(1.0, 0.1), 0.8, 1.2))
        draw["knee_soft"] = float(np.clip(draw["knee_soft"], 0.08, 0.25))
        draw["step_width"] = float(np.clip(draw["step_width"], 0.05, 0.16))
        draw["stance_width"] = float(np.clip(draw["stance_width"], 0.12, 0.30))
        draw["variability"] = float(np.clip(draw["variability"], 0.015, 0.05))
        draw["speed"] = float(np.clip(draw["speed"], 0.9, 1.65))
        draw["briskness"] = float(np.clip(draw["briskness"], 0.7, 1.4))
        return cls(**{name: float(value) for name, value in draw.items()})
