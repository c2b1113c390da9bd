"""Motion capture from what a person wears."""

__version__ = "0.1.0"


def load(pipeline: str, *overrides: str, checkpoint=None, device: str = "cpu"):
    """The system that `wearcap capture pipeline=PIPELINE checkpoint=CHECKPOINT` runs, as `wearcap.cli.conf.load`.

    wearcap.load("hmd2") has the shared checkpoint's network, wearcap.load("hps") needs none.
    """
    from wearcap.cli.conf import load as load_system

    return load_system(pipeline, *overrides, checkpoint=checkpoint, device=device)
