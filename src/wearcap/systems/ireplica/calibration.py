"""Calibration of a contact network during validation."""

import lightning
from lightning.pytorch import Callback

from wearcap.systems.ireplica.contact_transformer import fit_temperature
from wearcap.systems.ireplica.training import ContactDetection


class FitTemperature(Callback):
    """Fits the network's temperatures after every validation epoch; the checkpoint stores them with the weights.

    It must come before the weight averaging in the list of callbacks: the temperatures belong to the averaged weights.
    """

    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: ContactDetection) -> None:
        logits, truth = pl_module.validated()
        pl_module.net.temperature.copy_(fit_temperature(logits.flatten(0, 1), truth.flatten(0, 1)))
