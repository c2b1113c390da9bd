"""Embeddings of a head camera's images, computed once per file and encoder."""

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby, islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.errors import WearcapError
from wearcap.files import sha256_of
from wearcap.io.formats.video import read_frames, read_image
from wearcap.models.image_encoder import ImageEncoder
from wearcap.recording.recording import CameraStream

BATCH = 64
_KEYS = ("embedding", "embedding_mirrored")


def embedding_name(encoder: ImageEncoder) -> str:
    """Name of an encoder's embeddings in a camera stream: NAME-FINGERPRINT, as other weights give other embeddings."""
    return f"{encoder.name}-{encoder.fingerprint}"


def embed_camera(camera: CameraStream, folder: Path, encoder: ImageEncoder, cache: Path | None = None) -> CameraStream:
    """The stream with `embedding`, `embedding_mirrored` (float16) and `embedding_name`.

    `folder` is the data set's. Embeddings are kept in `cache` (default: `folder`/cache) below
    `embeddings-<name>-<fingerprint>`, named by the content of the pictures' files. Raises WearcapError for a stream
    without pictures, files that are missing or damaged, and another number of pictures than of timestamps.
    """
    files = _files(camera, folder)
    name = embedding_name(encoder)
    content = hashlib.sha256("".join(map(sha256_of, files)).encode()).hexdigest()
    kept = (cache or folder / "cache") / f"embeddings-{name}" / f"{content[:32]}.safetensors"
    embeddings = _read(kept, encoder.size)
    if embeddings is None:
        embeddings = _embed(pictures(camera, folder), encoder)
        write_tensors(kept, embeddings)
    count = len(embeddings["embedding"])
    if count != len(camera.timestamps):
        what = f"{count} pictures for {len(camera.timestamps)} timestamps"
        fix = "The video was cut or belongs to another recording: prepare the data set again."
        raise WearcapError(what, where=files[0], expected="a picture for each timestamp of the camera", fix=fix)
    return replace(camera, **embeddings, embedding_name=name)


def pictures(camera: CameraStream, folder: Path) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """A stream's images in order, from its video or its image files. Raises WearcapError as `embed_camera` does."""
    files = _files(camera, folder)
    if camera.video is not None:
        yield from (frame for _, frame in read_frames(files[0]))
    else:
        yield from (read_image(file) for file in files)


def _files(camera: CameraStream, folder: Path) -> list[Path]:
    """The video, or the image files. Raises WearcapError where there is none, or one is missing."""
    files = camera.files_in(folder)
    if not files:
        what = "this camera stream has no pictures"
        fix = "Prepare the data set with its camera."
        raise WearcapError(what, where=folder, expected="a video or image files", fix=fix)
    if missing := [file for file in files if not file.is_file()]:
        what = "no such video" if camera.video is not None else f"{len(missing)} of {len(files)} pictures are missing"
        expected = "the files that the recording names, below the data set's folder"
        raise WearcapError(what, where=missing[0], expected=expected)
    return files


def _read(path: Path, size: int) -> dict[str, Tensor] | None:
    """Cached embeddings, or None if they are missing or incomplete."""
    try:
        _, tensors = read_tensors(path, "file of embeddings")
    except WearcapError:
        return None
    whole = set(tensors) == set(_KEYS) and all(value.shape[1:] == (size,) for value in tensors.values())
    return tensors if whole else None


def _embed(
    frames: Iterator[UInt8[np.ndarray, "height width 3"]], encoder: ImageEncoder
) -> dict[str, Float[Tensor, "time feature"]]:
    parts = []
    for _, alike in groupby(frames, key=lambda frame: frame.shape):
        while images := list(islice(alike, BATCH)):
            batch = torch.from_numpy(np.stack(images))
            parts.append(torch.stack([encoder.embed(batch), encoder.embed(batch.flip(2))]).half().cpu())
    both = torch.cat(parts, 1) if parts else torch.zeros(2, 0, encoder.size).half()
    return dict(zip(_KEYS, both.contiguous().unbind()))
