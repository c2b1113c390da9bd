"""Image embeddings for the recordings of a data set with head camera pictures: dataset=DIR encoder=egoview, clip or dinov2.

This does not use the task engine: a failure must leave the recording in its data set, and a large encoder is loaded once.
"""

from dataclasses import replace
from pathlib import Path

from data_prep.shared.engine import Report, check_recording, registering
from wearcap.data.embeddings import embed_camera, embedding_name
from wearcap.errors import WearcapError, require_choice
from wearcap.files import remove_leftovers
from wearcap.locks import folder_lock
from wearcap.models.image_encoder import Clip, DinoV2, EgoViewEncoder, ImageEncoder
from wearcap.recording.recording import CameraStream
from wearcap.recording.store import Entry, RecordingFile, RecordingStore, save_recording


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
                        made[name] = _embed(store, name, file, encoder, cache)
                        report.written.append(name)
                except WearcapError as error:
                    report.failed[name] = str(error)
                finish(made)
    if len(report.notes) == len(store.entries):
        fix = "Prepare it with them, as `wearcap prepare simulated camera=true` does."
        raise WearcapError("no recording has a head camera's pictures", where=store.root, fix=fix)
    return report


def _embed(
    store: RecordingStore, name: str, file: RecordingFile, encoder: ImageEncoder, cache: str | Path | None
) -> Entry:
    recording, entry = file.load(), store.entries[name]
    assert recording.camera is not None
    camera = embed_camera(recording.camera, store.root, encoder, None if cache is None else Path(cache))
    recording = replace(recording, camera=camera)
    check_recording(recording)
    save_recording(recording, store.path_of(name))
    return Entry.of(recording, store.root, entry.split, entry.config_hash)
