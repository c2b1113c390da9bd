"""The kinematics' kernels for compiled functions, which leave them as they are."""

import torch

from wearcap.body.kinematics import fused_kinematics

fused = torch.compiler.disable(fused_kinematics)
