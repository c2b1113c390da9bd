"""Camera path and scene points from a plain video or a folder of images.

A single camera knows no metres and no gravity: scale and axes of the result are arbitrary.
"""

import itertools
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from PIL import Image
from torch import Tensor

from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.geometry.camera import Camera
from wearcap.geometry.trajectory import Trajectory, filled
from wearcap.io.formats.camera_json import camera_row, write_camera
from wearcap.io.formats.colmap import ColmapModel, read_colmap
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.poses import write_tum
from wearcap.io.formats.video import SUFFIXES, read_frames, read_image, video_info
from wearcap.localization.point_map import check_size
from wearcap.localization.structure import Advance, MappingSettings, map_pictures

FRAMES, STATE = "frames", "settings.json"


@dataclass(frozen=True)
class TrackSettings:
    """Image sampling, and interpolation of images that could not be placed."""

    fps: float | int
    """Images per second that are sampled from a video; frame rate of a folder's images."""
    max_gap_s: float | int
    """Longest gap between placed images that is interpolated."""
    mapping: MappingSettings


@dataclass(frozen=True)
class Pictures:
    """An ordered sequence of image files."""

    folder: Path
    names: tuple[str, ...]
    timestamps: Float64[Tensor, "picture"]

    @classmethod
    def of_folder(cls, folder: str | Path, fps: float) -> "Pictures":
        """A folder's images sorted by name, at `fps` per second."""
        folder = Path(folder)
        names = tuple(sorted(_pictures_in(folder)))
        if not names:
            raise WearcapError("no pictures in this folder", where=folder, expected=", ".join(SUFFIXES))
        return cls(folder, names, torch.arange(len(names), dtype=torch.float64) / fps)

    @classmethod
    def of_model(cls, model: ColmapModel, fps: float) -> "Pictures":
        """The images of a model sorted by name, assuming that none is missing."""
        names = tuple(photo.file.name for photo in model.photos)
        folder = model.photos[0].file.parent if model.photos else Path()
        return cls(folder, names, torch.arange(len(names), dtype=torch.float64) / fps)


@dataclass(frozen=True)
class Track:
    """A camera path in a world with arbitrary unit and axes."""

    T_world_cam: Trajectory
    """Poses of placed images, and of those in short gaps between them."""
    camera: Camera
    points_world: Float64[np.ndarray, "point 3"]
    colors: UInt8[np.ndarray, "point 3"]
    pictures: int
    placed: int
    gaps_s: tuple[tuple[float, float, bool], ...]
    """Start and end (s) of each stretch without placed images, and whether it was interpolated."""
    reprojection_px: float
    """Mean reprojection error of the points; NaN without tracks."""

    @classmethod
    def of_model(cls, model: ColmapModel, pictures: Pictures, max_gap_s: float, where: str | Path) -> "Track":
        """The path of a model's camera over a row of pictures; gaps up to `max_gap_s` are interpolated.

        Raises WearcapError when the model holds none of the pictures, or several cameras.
        """
        number = {name: index for index, name in enumerate(pictures.names)}
        photos = {number[photo.file.name]: photo for photo in model.photos if photo.file.name in number}
        if not photos:
            what = f"the model places none of {len(pictures.names)} pictures"
            expected = f"names such as {pictures.names[0]}" if pictures.names else "photos"
            raise WearcapError(what, where=where, expected=expected)
        cameras = {photo.camera for photo in photos.values()}
        if len(cameras) > 1:
            fix = "Map the video as taken with a single camera."
            raise WearcapError(f"{len(cameras)} cameras", where=where, expected="pictures of one camera", fix=fix)
        placed = torch.zeros(len(pictures.names), dtype=torch.bool)
        placed[list(photos)] = True
        R, t = torch.eye(3).repeat(len(placed), 1, 1), torch.zeros(len(placed), 3)
        for index, photo in photos.items():
            R[index], t[index] = photo.T_world_cam.R.float(), photo.T_world_cam.t.float()
        whole = filled(Trajectory(pictures.timestamps, R, t), placed)
        # Stretches without placed pictures (from the last one before to the first one after), and the frames kept
        kept, gaps = placed.clone(), []
        known = placed.nonzero()[:, 0]
        edges = [-1, *known.tolist(), len(placed)]
        for before, after in itertools.pairwise(edges):
            if after - before > 1:
                inside = before >= 0 and after < len(placed)
                start, stop = (
                    pictures.timestamps[max(before, 0)].item(),
                    pictures.timestamps[min(after, len(placed) - 1)].item(),
                )
                bridged = inside and stop - start <= max_gap_s
                kept[before + 1 : after] = bridged
                gaps.append((start, stop, bridged))
        tracks, distances = model.tracks, [np.zeros(0)]
        for index, photo in enumerate(model.photos):
            mine = tracks.photo == index
            points = torch.from_numpy(tracks.points_world[tracks.point[mine]])
            pixels, valid = photo.camera.project(photo.T_world_cam.inverse() @ points)  # pyright: ignore[reportArgumentType]
            distances.append(np.linalg.norm(pixels.numpy() - tracks.pixels[mine], axis=1)[valid.numpy()])
        joined = np.concatenate(distances)
        return cls(
            whole[kept],
            next(iter(cameras)),
            tracks.points_world,
            tracks.colors,
            len(placed),
            int(placed.sum()),
            tuple(gaps),
            float(joined.mean()) if len(joined) else float("nan"),
        )

    def write(self, output: str | Path, source: str) -> None:
        """Write trajectory.txt (TUM), points.ply, camera.json and report.json into a folder."""
        output = Path(output)
        write_tum(self.T_world_cam, output / "trajectory.txt")
        points = self.points_world.astype(np.float32)
        write_ply(Ply(points, self.colors), output / "points.ply")
        error = None if np.isnan(self.reprojection_px) else round(self.reprojection_px, 4)
        write_camera(self.camera, output / "camera.json", {"source": source, "reprojection_px": error})
        report = {
            "source": source,
            "scale": "arbitrary: no metres, no gravity",
            "pictures": self.pictures,
            "placed": self.placed,
            "placed_share": round(self.placed / self.pictures, 4),
            "interpolated": len(self.T_world_cam) - self.placed,
            "points": len(self.points_world),
            "reprojection_px": error,
            "gaps": [
                {"start_s": start, "stop_s": stop, "interpolated": bridged} for start, stop, bridged in self.gaps_s
            ],
        }
        write_text(output / "report.json", json.dumps(report, indent=1) + "\n")


def track_pictures(
    source: str | Path, output: str | Path, settings: TrackSettings, camera: Camera | None, advance: Advance
) -> Track:
    """Track the camera of a video or of a folder of pictures; `output` keeps intermediate results.

    A run that was stopped goes on, a finished reconstruction is taken as it is. Raises WearcapError when `output`
    belongs to another source or other settings, without pictures, and as `map_pictures` does.
    """
    source, output = Path(source), Path(output)
    if not source.exists():
        raise WearcapError("no such file or folder", where=source, expected="a video, or a folder of pictures")
    _claim(source, output, settings, camera)
    pictures = (
        Pictures.of_folder(source, settings.fps) if source.is_dir() else _frames(source, output, settings.fps, advance)
    )
    if len(pictures.names) < 3:
        what = f"{len(pictures.names)} pictures"
        raise WearcapError(what, where=source, expected="at least 3", fix="Take more a second: fps=…")
    if camera is not None:
        check_size(read_image(pictures.folder / pictures.names[0]), camera, pictures.names[0])
    model = map_pictures(pictures.names, pictures.folder, output, camera, settings.mapping, advance)
    return Track.of_model(read_colmap(model, pictures.folder), pictures, settings.max_gap_s, where=output)


def _claim(source: Path, output: Path, settings: TrackSettings, camera: Camera | None) -> None:
    """Record source and settings in the folder. Raises WearcapError when it holds another track."""
    about = source.stat()
    mine = {
        "source": str(source.resolve()),
        "bytes": about.st_size if source.is_file() else len(_pictures_in(source)),
        "fps": float(settings.fps),
        "mapping": asdict(settings.mapping),
        "camera": None if camera is None else camera_row(camera),
    }
    mine["mapping"].pop("threads")
    if (output / STATE).is_file():
        if read_json(output / STATE) != mine:
            what = "this folder holds the track of another source, or of other settings"
            raise WearcapError(what, where=output, expected=str(output / STATE), fix="Choose another: output=DIR.")
        return
    write_text(output / STATE, json.dumps(mine, indent=1) + "\n")


def _pictures_in(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]


def _frames(video: Path, output: Path, fps: float, advance: Advance) -> Pictures:
    """Frames of a video nearest to an even clock, as JPEGs in `output`/frames, with the video's timestamps."""
    folder, listed = output / FRAMES, output / FRAMES / "times.json"
    rows: dict[str, float] = read_json(listed) if listed.is_file() else {}
    if not rows:
        info = video_info(video)
        expected = max(int(info.frames / info.fps * fps), 1)
        folder.mkdir(parents=True, exist_ok=True)
        for time, picture in read_frames(video):
            if time * fps + 0.5 * fps / info.fps < len(rows):
                continue
            name = f"{len(rows):06d}.jpg"
            with atomic_path(folder / name) as temporary:
                Image.fromarray(picture).save(temporary, quality=95)
            rows[name] = time
            advance("pictures", min(len(rows), expected), expected)
        write_text(listed, json.dumps(rows, indent=0) + "\n")
    return Pictures(folder, tuple(rows), torch.tensor(list(rows.values()), dtype=torch.float64))
