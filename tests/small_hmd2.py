"""HMD² around a small network: settings by their own names, without the groups that a config has."""

from dataclasses import fields

from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.systems.hmd2.conditions import Hands, Images, Points
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2, Overlap, Sampling
from wearcap.systems.hmd2.windows import DiffusionModel


def hmd2_of(
    net: MotionDenoiser,
    features: HeadFeatures,
    skeleton: Skeleton | None = None,
    place_encoder: VoxelAutoencoder | None = None,
    image_encoder: str | None = None,
    **settings,
) -> HMD2:
    skeleton = skeleton or xsens23()
    images = Images(net.conditions["image"], image_encoder) if "image" in net.conditions else None
    kinds = {"points": None if place_encoder is None else Points(place_encoder), "image": images, "hands": Hands()}
    conditions = {name: condition for name in net.conditions if (condition := kinds[name]) is not None}
    model = DiffusionModel(net, features, CosineSchedule(), skeleton, 60.0, conditions)
    sampling, overlap = (
        kind(**{field.name: settings.pop(field.name) for field in fields(kind) if field.name in settings})
        for kind in (Sampling, Overlap)
    )
    return HMD2(model, sampling, overlap, **settings)
