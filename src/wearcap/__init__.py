"""Motion capture from what a person wears."""

__version__ = "0.1.0"


def load(pipeline: str, *overrides: str, checkpoint=None, device: str = "cpu"):
    """The `runtime.system.System` that `wearcap capture pipeline=PIPELINE checkpoint=CHECKPOINT` runs.

    wearcap.load("hmd2") has the shared checkpoint's network, wearcap.load("hps") needs none. `overrides` are those of the
    command line ("pipeline.sampling.steps=20"). Raises WearcapError for an unknown pipeline or setting, and for a checkpoint that
    the pipeline cannot use.
    """
    from wearcap.cli.conf import compose, load_pipeline

    config = compose("capture", [f"pipeline={pipeline}", *overrides, "recording=none"])
    return load_pipeline(checkpoint, config.pipeline, device, shared=True)
