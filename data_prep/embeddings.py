"""Image embeddings for the recordings of a data set with head camera pictures: dataset=DIR encoder=egoview, clip or dinov2.

This does not use the task engine: a failure must leave the recording in its data set, and a large encoder is loaded once.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby, islice
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from data_prep.pretrained_images import Clip, DinoV2
from data_prep.shared.engine import Report, check_recording, registering
from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.data.pictures import picture_files, pictures
from wearcap.errors import WearcapError, require_choice
from wearcap.files import remove_leftovers, sha256_of
from wearcap.locks import folder_lock
from wearcap.models.image_encoder import EgoViewEncoder
from wearcap.recording.recording import CameraStream
from wearcap.recording.store import Entry, RecordingFile, RecordingStore, save_recording

BATCH = 64
_KEYS = ("embedding", "embedding_mirrored")


@runtime_checkable
class ImageEncoder(Protocol):
    """The interface of an image encoder."""

    name: str
    size: int
    """Length of an embedding."""

    @property
    def fingerprint(self) -> str:
        """8 hex digits that differ between encoders with different embeddings of the same image."""
        ...

    def embed(self, frames: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch feature"]:
        """Embeddings of RGB images of any size, on the encoder's device."""
        ...


def embeddings_rework(
    dataset: str | Path,  # a folder that `wearcap prepare` made; its recordings are rewritten one by one
    # egoview, clip (the paper's, by open_clip) or dinov2 (by timm): pip install "wearcap[images]"
    encoder: str = "egoview",
    checkpoint: str = "egoview",  # of egoview: a checkpoint's name or file
    # of clip and dinov2: a file; null: $WEARCAP_CLIP_WEIGHTS, $WEARCAP_DINOV2_WEIGHTS or the user's caches
    weights: str | None = None,
    cache: str | Path | None = None,  # where embeddings are kept by content of the pictures; null: dataset/cache
    overwrite: bool = False,
) -> Report:
    """Embeddings by one of the encoders, added by `embed_dataset`. Raises WearcapError for another one."""
    require_choice(encoder, ("egoview", "clip", "dinov2"), f"no image encoder {encoder!r}")
    if encoder == "egoview":
        return embed_dataset(dataset, EgoViewEncoder.load(checkpoint), cache, overwrite)
    return embed_dataset(dataset, {"clip": Clip, "dinov2": DinoV2}[encoder](weights), cache, overwrite)


def embed_dataset(
    dataset: str | Path, encoder: ImageEncoder, cache: str | Path | None = None, overwrite: bool = False
) -> Report:
    """Add embeddings by `encoder` to every recording with head-camera pictures, rewriting its file.

    Recordings that have them already are left unchanged, so that a killed run resumes where it stopped. A recording whose
    pictures are missing or damaged is reported and left unchanged. The manifest's config hash stays: the source is
    the same. `cache`: see `embed_camera`. Raises WearcapError when no recording has pictures, and when another run writes
    into the data set.
    """
    root = RecordingStore.open(dataset).root
    name_of_all = embedding_name(encoder)
    report = Report()
    with folder_lock(root, "prepare embeddings"):
        remove_leftovers(root, below=True)
        store = RecordingStore.open(root)
        with registering(store, len(store.entries)) as finish:
            for name in store.names():
                path, made = store.path_of(name), dict[str, Entry]()
                try:
                    # A killed run leaves files that are younger than the manifest; they are written again.
                    registered = not path.is_file() or path.stat().st_mtime_ns <= store.manifest_path.stat().st_mtime_ns
                    file = RecordingFile(path, verify=registered)
                    camera = file.part("camera")
                    if not isinstance(camera, CameraStream) or not (camera.video or camera.image_files):
                        report.notes[name] = "no head camera's pictures"
                    elif (
                        registered
                        and not overwrite
                        and camera.embedding is not None
                        and camera.embedding_mirrored is not None
                        and camera.embedding_name == name_of_all
                    ):
                        report.current.append(name)
                    else:
                        made[name] = _embedded(store, name, file, encoder, cache)
                        report.written.append(name)
                except WearcapError as error:
                    report.failed[name] = str(error)
                finish(made)
    if len(report.notes) == len(store.entries):
        fix = "Prepare it with them, as `wearcap prepare simulated camera=true` does."
        raise WearcapError("no recording has a head camera's pictures", where=store.root, fix=fix)
    return report


def _embedded(
    store: RecordingStore, name: str, file: RecordingFile, encoder: ImageEncoder, cache: str | Path | None
) -> Entry:
    recording, entry = file.load(), store.entries[name]
    assert recording.camera is not None
    camera = embed_camera(recording.camera, store.root, encoder, None if cache is None else Path(cache))
    recording = replace(recording, camera=camera)
    check_recording(recording)
    save_recording(recording, store.path_of(name))
    return Entry.of(recording, store.root, entry.split, entry.config_hash)


def embedding_name(encoder: ImageEncoder) -> str:
    """Name of an encoder's embeddings in a camera stream: NAME-FINGERPRINT, as other weights give other embeddings."""
    return f"{encoder.name}-{encoder.fingerprint}"


def embed_camera(camera: CameraStream, folder: Path, encoder: ImageEncoder, cache: Path | None = None) -> CameraStream:
    """The stream with `embedding`, `embedding_mirrored` (float16) and `embedding_name`.

    `folder` is the data set's. Embeddings are kept in `cache` (default: `folder`/cache) below
    `embeddings-<name>-<fingerprint>`, named by the content of the pictures' files. Raises WearcapError for a stream
    without pictures, files that are missing or damaged, and another number of pictures than of timestamps.
    """
    files = picture_files(camera, folder)
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
