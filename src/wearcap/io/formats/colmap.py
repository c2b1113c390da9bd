"""Models of COLMAP (text and binary): calibrated photos with their poses, and the tracks of 3D points they saw.

COLMAP puts the centre of the first pixel at (0.5, 0.5); here it is at (0, 0), and pixels are shifted accordingly.
The model's unit and axes are left as they are: structure from motion knows neither metres nor gravity.
"""

import math
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8

from wearcap.boundary.opening import read_bytes, understood
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.light_roma import roma
from wearcap.geometry.rigid import Rigid
from wearcap.scene.scan import Photo

_MODELS = {
    "SIMPLE_PINHOLE": ("pinhole", 3),
    "PINHOLE": ("pinhole", 4),
    "SIMPLE_RADIAL": ("opencv", 4),
    "RADIAL": ("opencv", 5),
    "OPENCV": ("opencv", 8),
    "OPENCV_FISHEYE": ("fisheye", 8),
}
"""wearcap's camera model, and the number of parameters of COLMAP's."""
_BY_NUMBER = (*_MODELS, "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE")
"""COLMAP's models by their number in binary files."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """3D points of structure from motion and their observations."""

    points_world: Float64[np.ndarray, "point 3"]
    colors: UInt8[np.ndarray, "point 3"]
    photo: Int64[np.ndarray, "observation"]
    """Index of the photo of each observation."""
    point: Int64[np.ndarray, "observation"]
    pixels: Float32[np.ndarray, "observation 2"]

    def of_photos(self, chosen: Int64[np.ndarray, "chosen"]) -> "Tracks":
        """The observations in some photos, which are renumbered in the given order."""
        order = np.argsort(chosen)
        place = np.minimum(np.searchsorted(chosen[order], self.photo), max(len(chosen) - 1, 0))
        keep = np.isin(self.photo, chosen)
        return Tracks(self.points_world, self.colors, order[place[keep]], self.point[keep], self.pixels[keep])


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """Content of a COLMAP model: photos in the order of their names, and the tracks."""

    photos: list[Photo]
    tracks: Tracks


@dataclass(frozen=True, eq=False)
class _Image:
    name: str
    camera: int
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    pixels: np.ndarray
    point: np.ndarray
    where: str


@dataclass(eq=False)
class _Points:
    """3D points one after another: their numbers, coordinates and colours."""

    number: "array[int]" = field(default_factory=lambda: array("q"))
    xyz: "array[float]" = field(default_factory=lambda: array("d"))
    rgb: bytearray = field(default_factory=bytearray)


def read_colmap(folder: str | Path, images: str | Path | None = None) -> ColmapModel:
    """Read cameras, images and points3D (.bin where it is there, else .txt) from a model's folder.

    Without a points3D file, as in models of poses alone, there are no tracks.
    `images`: folder of the picture files (default: `images` beside the model, else the model's own folder).
    Raises WearcapError for missing or truncated files, unknown camera models, and numbers that name nothing.
    """
    folder = Path(folder)
    places = (folder / "images", folder.parent / "images", folder.parent.parent / "images")
    images = Path(images) if images is not None else next((place for place in places if place.is_dir()), folder)
    binary = (folder / "images.bin").is_file()
    reader, suffix = (_Binary, ".bin") if binary else (_Text, ".txt")
    cameras = reader.cameras(folder / f"cameras{suffix}")
    found = sorted(reader.images(folder / f"images{suffix}"), key=lambda image: image.name)
    points, file = _Points(), folder / f"points3D{suffix}"
    if file.is_file():
        points = reader.points(file)
        if not np.isfinite(points.xyz).all():
            raise WearcapError("a point is NaN or infinite", file, "finite coordinates")
    return ColmapModel([_photo(image, cameras, images) for image in found], _tracks(found, points))


def read_images(path: str | Path) -> list[_Image]:
    """The pictures of an images.txt or images.bin alone, as they stand there.

    Raises WearcapError for a truncated file and lines that are none of its format.
    """
    return (_Binary if Path(path).suffix == ".bin" else _Text).images(Path(path))


def _photo(image: _Image, cameras: dict[int, Camera], images: Path) -> Photo:
    if image.camera not in cameras:
        what = f"image {image.name!r} names camera {image.camera}, which is not in the model"
        raise WearcapError(what, image.where, f"one of {', '.join(map(str, sorted(cameras)))}")
    wxyz = torch.tensor(image.quaternion_wxyz, dtype=torch.float64)
    if not (wxyz.isfinite().all() and 0.9 < wxyz.norm() < 1.1 and all(map(math.isfinite, image.translation))):
        what = f"image {image.name!r} has no valid pose"
        raise WearcapError(what, image.where, "a unit quaternion (w first) and a finite translation")
    wxyz = wxyz / wxyz.norm()
    R_cam_world = roma.unitquat_to_rotmat(wxyz[[1, 2, 3, 0]])
    T_cam_world = Rigid(R_cam_world, torch.tensor(image.translation, dtype=torch.float64))
    return Photo(images / image.name, cameras[image.camera], T_cam_world.inverse())


def _tracks(images: list[_Image], points: _Points) -> Tracks:
    """Observations of points that exist; their numbers become rows."""
    number = np.array(points.number, np.int64)
    order = np.argsort(number)
    number = number[order]
    photo = np.repeat(np.arange(len(images)), [len(image.point) for image in images])
    pixels = np.concatenate([np.zeros((0, 2)), *(image.pixels for image in images)])
    seen = np.concatenate([np.zeros(0, np.int64), *(image.point for image in images)])
    place = np.minimum(np.searchsorted(number, seen), max(len(number) - 1, 0))
    known = (seen >= 0) & (len(number) > 0) & (np.abs(pixels) < 1e6).all(1)
    known[known] = number[place[known]] == seen[known]
    return Tracks(
        np.array(points.xyz, np.float64).reshape(-1, 3),
        np.array(points.rgb, np.uint8).reshape(-1, 3),
        photo[known].astype(np.int64),
        order[place[known]].astype(np.int64),
        (pixels[known] - 0.5).astype(np.float32),
    )


def _camera(model: str, width: int, height: int, values: list[float], where: str) -> Camera:
    if model not in _MODELS:
        fix = "COLMAP's image_undistorter turns any model into PINHOLE."
        raise WearcapError(f"camera model {model} is not supported", where, f"one of {', '.join(_MODELS)}", fix)
    ours, count = _MODELS[model]
    if len(values) != count or not all(map(math.isfinite, values)):
        raise WearcapError(f"camera model {model} with parameters {values}", where, f"{count} finite numbers")
    single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    fx, fy, cx, cy, *lens = (values[:1] if single else []) + values
    if ours == "opencv":
        lens = [*lens, 0.0, 0.0, 0.0][:4]
    return Camera(ours, width, height, fx, fy, cx - 0.5, cy - 0.5, tuple(lens))


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Position and words of each line, without comments but with empty lines."""
    for number, line in numbered_lines(path):
        if not line.startswith("#"):
            yield at_line(path, number), line.split()


class _Text:
    """A model as text."""

    @staticmethod
    def cameras(path: Path) -> dict[int, Camera]:
        cameras = {}
        for where, words in _lines(path):
            if words:
                with understood("cannot be understood", where, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS…"):
                    number, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
                    values = [float(word) for word in words[4:]]
                cameras[number] = _camera(model, width, height, values, where)
        return cameras

    @staticmethod
    def images(path: Path) -> list[_Image]:
        images = []
        lines = _lines(path)
        for where, words in lines:
            if not words:
                continue
            with understood(
                "cannot be understood", where, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its points"
            ):
                _, *pose, camera, name = [*words[:9], " ".join(words[9:])]
                pose = [float(word) for word in pose]
                if not name:
                    raise ValueError("no name")
                place, second = next(lines, (where, None))
                if second is None:
                    what = f"it ends after image {name!r}"
                    raise WearcapError(what, where, "a line of its points", "The file was cut short: copy it again.")
                if len(second) % 3:
                    what = f"{len(second)} numbers for the points of image {name!r}"
                    raise WearcapError(what, place, "X Y POINT3D_ID for each point")
                table = finite_floats(second).reshape(-1, 3)
                points = table[:, :2], table[:, 2].astype(np.int64)
                images.append(_Image(name, int(camera), tuple(pose[:4]), tuple(pose[4:]), *points, where))
        return images

    @staticmethod
    def points(path: Path) -> _Points:
        points = _Points()
        for where, words in _lines(path):
            if words:
                with understood("cannot be understood", where, "POINT3D_ID X Y Z R G B ERROR TRACK…"):
                    if len(words) < 7:
                        raise ValueError("too few numbers")
                    points.number.append(int(words[0]))
                    points.xyz.extend(map(float, words[1:4]))
                    points.rgb += bytes(map(int, words[4:7]))  # raises beyond 0…255
        return points


class _Cursor:
    """Reads structures one after another; errors name the part of the file that ended too early."""

    def __init__(self, path: Path):
        self.path, self.data, self.place = path, read_bytes(path, "colmap"), 0

    def take(self, form: str, part: str) -> tuple:
        try:
            values = struct.unpack_from("<" + form, self.data, self.place)
        except struct.error as error:
            raise self.cut_short(part) from error
        self.place += struct.calcsize("<" + form)
        return values

    def rows(self, count: int, dtype: np.dtype, part: str) -> np.ndarray:
        if count * dtype.itemsize > len(self.data) - self.place:
            raise self.cut_short(part)
        table = np.frombuffer(self.data, dtype, count, self.place)
        self.place += count * dtype.itemsize
        return table

    def text(self, part: str) -> str:
        stop = self.data.find(b"\0", self.place, self.place + 4096)
        if stop < 0:
            raise self.cut_short(part)
        content, self.place = self.data[self.place : stop], stop + 1
        return content.decode("utf-8", errors="replace")

    def cut_short(self, part: str) -> WearcapError:
        what = f"it ends inside {part}"
        return WearcapError(what, self.path, "a whole COLMAP file", "The file was cut short: copy it again.")


class _Binary:
    """A model in binary files (little-endian, without padding)."""

    @staticmethod
    def cameras(path: Path) -> dict[int, Camera]:
        cursor, cameras = _Cursor(path), {}
        (count,) = cursor.take("Q", "its count")
        for row in range(count):
            where = f"camera {row + 1} of {count}"
            number, model, width, height = cursor.take("iiQQ", where)
            name = _BY_NUMBER[model] if 0 <= model < len(_BY_NUMBER) else f"number {model}"
            parameters = cursor.take(f"{_MODELS[name][1]}d", where) if name in _MODELS else ()
            cameras[number] = _camera(name, width, height, list(parameters), str(path))
        return cameras

    @staticmethod
    def images(path: Path) -> list[_Image]:
        cursor, images = _Cursor(path), []
        observation = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
        (count,) = cursor.take("Q", "its count")
        for row in range(count):
            where = f"image {row + 1} of {count}"
            _, *pose, camera = cursor.take("I7dI", where)
            name = cursor.text(where)
            (length,) = cursor.take("Q", where)
            table = cursor.rows(length, observation, where)
            points = table["xy"].astype(np.float64), table["point"].astype(np.int64)
            images.append(_Image(name, camera, tuple(pose[:4]), tuple(pose[4:]), *points, str(path)))
        return images

    @staticmethod
    def points(path: Path) -> _Points:
        cursor, points = _Cursor(path), _Points()
        (count,) = cursor.take("Q", "its count")
        for row in range(count):
            where = f"point {row + 1} of {count}"
            number, x, y, z, red, green, blue, _, length = cursor.take("q3d3BdQ", where)
            cursor.rows(length, np.dtype("<i4, <i4"), where)
            points.number.append(number)
            points.xyz.extend((x, y, z))
            points.rgb += bytes((red, green, blue))
        return points
