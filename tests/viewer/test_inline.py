"""A motion inside a notebook is a video that a browser plays."""

import base64
import io
import re

import av
import pytest

import wearcap
from wearcap.errors import WearcapError
from wearcap_testing import swaying_motion


def test_a_notebook_shows_motions_side_by_side():
    motion = swaying_motion(60, fps=60.0)
    shown = wearcap.show(motion, seconds=0.5, fps=10.0, size=(64, 48), truth=motion)
    labelled = wearcap.show(truth=motion, capture=motion, seconds=0.5, fps=10.0, size=(64, 48))
    assert labelled.mp4 != shown.mp4, "captions differ"
    (encoded,) = re.findall(r'<video [^>]*src="data:video/mp4;base64,([^"]+)"></video>', shown._repr_html_())
    with av.open(io.BytesIO(base64.b64decode(encoded))) as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert [picture.shape for picture in pictures] == [(48, 2 * 64, 3)] * 6
    assert (pictures[0] != pictures[-1]).any()
    assert len(repr(shown)) < 100


def test_no_motion_and_motions_that_share_no_time_are_refused():
    with pytest.raises(WearcapError, match="no motion"):
        wearcap.show()
    motion = swaying_motion(10)
    later = swaying_motion(10)
    later.timestamps.add_(100.0)
    with pytest.raises(WearcapError, match="share no time"):
        wearcap.show(motion, later=later)
