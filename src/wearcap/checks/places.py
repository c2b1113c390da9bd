"""Checks of places: a scene's scan and database photos, a visual map, and an environment's objects with their freedoms."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from wearcap.boundary.tensors import open_tensors
from wearcap.checks.report import Check, Finding, refusal
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import face_normals, random_points
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.io.formats.camera_json import PHOTOS_FILE as PHOTOS
from wearcap.io.formats.camera_json import read_photos
from wearcap.io.formats.environment import FILE_NAME as ENVIRONMENT
from wearcap.io.formats.environment import read_environment
from wearcap.io.formats.navvis import CLOUD, is_navvis_scan, read_navvis_scan
from wearcap.io.formats.scene_folder import read_scan
from wearcap.io.formats.video import open_image
from wearcap.localization.visual_map import MAP, VisualMap
from wearcap.recording import PointCloud, Recording
from wearcap.scene.objects import FREEDOMS, Environment, SceneObject
from wearcap.scene.scan import Photo, Scan

SPARSE_M = 0.03
"""Spacing (m) beyond which pictures rendered from a scan have holes at arm's length."""
TINY_M, HUGE_M = 0.05, 12.0
"""Range of the longest side (m) of an object's bounding box outside which its unit is doubtful."""
HINGE_GAP_M = 0.10
FLOOR_M = 0.10
"""Largest distance (m) of a sliding object from the common floor of all."""
SAME_SURFACE_M = 0.02
_SAME_SHARE, _INSIDE_SHARE = 0.5, 0.8
_SAMPLES = 400
_CELL_M = 0.1
_FEW_KEYPOINTS = 30
_LOOKED_AT = 40
"""Most photos whose files are opened."""
_MARGIN_M = 1.0
"""Largest distance (m) of photos from the scan's bounding box."""
_POINTS = 50_000
"""Number of points of the scan that are projected into photos."""


def is_place(folder: Path) -> bool:
    """Whether a folder holds an environment, or a scan with photos: wearcap's (photos.json) or NavVis' (sensor_frame.xml)."""
    return any((folder / file).is_file() for file in (ENVIRONMENT, PHOTOS, CLOUD)) or is_navvis_scan(folder)


def read_place(folder: Path) -> tuple[Recording, list[Finding]]:
    """A scan as points, with all findings about scan, photos and environment, including errors of reading them."""
    findings: list[Finding] = []
    scan, photos = None, None
    if (folder / CLOUD).is_file() or (folder / PHOTOS).is_file() or is_navvis_scan(folder):
        try:
            scan = read_scan(folder / CLOUD)
            findings += _check_scan(scan)
        except WearcapError as error:
            fix = "Export the scene's cloud there."
            missing = Check("scan").error("the scan is missing", str(folder / CLOUD), fix)
            findings.append(refusal(error, "scan") if (folder / CLOUD).is_file() else missing)
        navvis = is_navvis_scan(folder) and not (folder / PHOTOS).is_file()
        try:
            photos = read_navvis_scan(folder)[1] if navvis else read_photos(folder)
            check = Check("photos")
            missing = [photo.file.name for photo in photos if not photo.file.is_file()]
            if not photos:
                fix = "List them in photos.json."
                findings.append(check.error("no photos", "a map of this scene would be empty", fix))
            elif missing:
                evidence = f"{len(missing)} of {len(photos)}, as {missing[:3]}"
                fix = "Put them at the paths in photos.json."
                findings.append(check.error("image files are missing", evidence, fix))
            else:
                calibrations = f"{len({photo.camera for photo in photos})} calibrations"
                some = photos[:: -(-len(photos) // _LOOKED_AT)]
                findings += [check.ok(f"{len(photos)} photos", calibrations), _check_sizes(some)]
                findings += [] if scan is None else [_check_sight(some, scan)]
        except WearcapError as error:
            fix = "List pictures with their cameras and poses in photos.json."
            none = Check("photos").error("no photos", "a map of this scene would be empty", fix)
            findings.append(refusal(error, "photos") if navvis or (folder / PHOTOS).is_file() else none)
    if (folder / ENVIRONMENT).is_file():
        findings += read_environment_file(folder)[1]
    shown = torch.zeros(0, 3) if scan is None else torch.from_numpy(_thinned(scan.points))
    return Recording(folder.resolve().name, points=PointCloud(shown) if len(shown) else None), findings


def is_map(path: Path) -> bool:
    """Whether a .safetensors file is marked as a visual map."""
    try:
        return MAP in (open_tensors(path, "map").metadata() or {})
    except WearcapError:
        return False


def read_map(path: Path) -> tuple[Recording, list[Finding]]:
    """A visual map's landmarks, with findings about whether cameras can be localised in it."""
    check, visual_map = Check("map"), VisualMap.load(path)
    points, pictures = visual_map.landmarks.points_world, len(visual_map)
    if not len(points) or not pictures:
        evidence = f"{pictures} pictures, {len(points)} landmarks"
        fix = "Build it from photos that show the scene: wearcap scene."
        return Recording(path.name), [check.error("the map is empty", evidence, fix)]
    seen = np.diff(visual_map.observations.first)
    evidence = (
        f"{pictures} pictures, {len(points)} landmarks, {np.median(seen):.0f} keypoints in half of the pictures or more"
    )
    bare = float((seen < _FEW_KEYPOINTS).mean())
    found = check.ok("holds landmarks", evidence)
    if bare > 0.3:
        fix = "Pictures of bare walls help nobody: take others, or larger ones."
        found = check.warning("pictures with hardly a keypoint", f"{100 * bare:.0f} % of them; {evidence}", fix)
    return Recording(path.name, points=PointCloud(torch.from_numpy(_thinned(points.astype(np.float32))))), [found]


def _check_scan(scan: Scan) -> list[Finding]:
    """Extent, colour, density and up axis of a scan that is in metres."""
    extent = np.ptp(scan.points, axis=0)
    size = " x ".join(f"{side:.1f}" for side in extent)
    findings = [Check("scan").ok("in metres", f"{len(scan.points)} points, {size} m")]
    check = Check("scan: colour")
    if scan.colors is None:
        fix = "Export it with red, green, blue: pictures are drawn from it."
        findings.append(check.error("the scan has no colour", f"{len(scan.points)} points", fix))
    elif scan.colors.std() < 1:
        fix = "Export it with the scanner's colours: nothing can be recognised in it."
        findings.append(check.error("all points have one colour", f"{scan.colors[0].tolist()}", fix))
    # The distance of neighbouring points on a surface follows from the points per occupied cell.
    cells = np.floor((scan.points - scan.points.min(0)) / _CELL_M).astype(np.int64)
    sides = cells.max(0) + 1
    _, counts = np.unique((cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2], return_counts=True)
    spacing = float(_CELL_M / np.sqrt(np.median(counts)))
    check, evidence = Check("scan: density"), f"points about {100 * spacing:.1f} cm apart"
    if spacing > SPARSE_M:
        fix = "Pictures drawn from it have holes: export it at 1 cm or less."
        findings.append(check.warning("the scan is sparse", evidence, fix))
    else:
        findings.append(check.ok("dense", evidence))
    if extent[2] > 1.5 * extent[:2].max():
        fix = "z should point up: turn the scan and its photos' poses together."
        findings.append(Check("scan: up axis").warning("the scan is taller than wide", f"{size} m", fix))
    return findings


def _check_sizes(photos: list[Photo]) -> Finding:
    for photo in photos:
        try:
            with open_image(photo.file) as image:
                width, height = image.size
        except WearcapError as error:
            evidence = f"{photo.file.name}: {error.what}"
            return Check("photos: files").error("a photo cannot be read", evidence, "Fetch it again.")
        camera = photo.camera
        if (width, height) != (camera.width, camera.height):
            evidence = f"{photo.file.name} has {width}x{height} pixels, its camera {camera.width}x{camera.height}"
            fix = "Use the pictures that were calibrated, or scale the intrinsics (Camera.scaled)."
            return Check("photos: size").error("image size and calibration differ", evidence, fix)
    return Check("photos: size").ok("as calibrated", f"{len(photos)} opened")


def _check_sight(photos: list[Photo], scan: Scan) -> Finding:
    """Whether photos were taken within the scan, and have points of it within 10 m in view."""
    check, points = Check("photos: poses"), torch.from_numpy(_thinned(scan.points))
    low, high = points.amin(0) - _MARGIN_M, points.amax(0) + _MARGIN_M
    shares = torch.zeros(len(photos))
    for k, photo in enumerate(photos):
        if not ((photo.T_world_cam.t >= low) & (photo.T_world_cam.t <= high)).all():
            continue
        near = points[(points - photo.T_world_cam.t).norm(dim=-1) < 10.0]
        if len(near) > 20:
            shares[k] = photo.camera.project(photo.T_world_cam.inverse() @ near)[1].float().mean()
    blind = int((shares < 0.01).sum())
    if blind > len(photos) / 2:
        evidence = f"{blind} of {len(photos)} were taken outside it, or have none of it in view"
        fix = "Poses are of OpenCV's camera in the scan's world, in metres; perhaps they are inverted."
        return check.error("photos do not see the scan", evidence, fix)
    if blind > len(photos) / 10:
        evidence = f"{blind} of {len(photos)}"
        return check.warning("some photos do not see the scan", evidence, "They add nothing to a map.")
    half = f"half of {len(photos)} photos have at least {100 * shares.median():.0f} %"
    return check.ok("photos see the scan", f"{half} of the points within 10 m in view")


def _thinned(points: Float32[np.ndarray, "point 3"]) -> Float32[np.ndarray, "chosen 3"]:
    return np.ascontiguousarray(points[:: len(points) // _POINTS + 1])


def read_environment_file(path: Path) -> tuple[Recording, list[Finding]]:
    """All findings about an environment.json, including errors of reading it."""
    try:
        return Recording(path.name), _check_environment(read_environment(path))
    except WearcapError as error:
        return Recording(path.name), [refusal(error, "environment")]


def _check_environment(environment: Environment) -> list[Finding]:
    """One finding per object with its category, position and degrees of freedom, then likely problems."""
    check, objects = Check("environment"), environment.objects
    if not objects:
        return [check.warning("no objects", "nothing in it can be moved", "Add some: wearcap scene.")]
    kinds = [item.freedom.kind for item in objects]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
    findings = [check.ok(f"{len(objects)} objects", counts)]
    for item in objects:
        moves = FREEDOMS[item.freedom.kind]
        if item.freedom.limits is not None:
            low, high = item.freedom.limits
            degrees = f"{math.degrees(low):.0f}° to {math.degrees(high):.0f}°"
            moves += f", {degrees if item.freedom.kind == 'hinge' else f'{low:.2f} to {high:.2f} m'}"
        size = " x ".join(f"{side:.2f}" for side in np.ptp(item.box_world, axis=0))
        at = ", ".join(f"{v:.2f}" for v in item.t_world_object.tolist())
        triangles = len(item.mesh.faces)
        shape = f"{triangles} triangles" if triangles else f"a cloud of {len(item.mesh.vertices)} points"
        check = Check(f"object {item.name}")
        findings.append(check.ok(f"{item.category or 'object'}: {moves}", f"{size} m, {shape}, at ({at}) m"))
    for item in objects:
        check, longest = Check(f"object {item.name}: size"), float(np.ptp(item.box_world, axis=0).max())
        if longest < TINY_M:
            fix = "Is it in another unit? Meshes are in metres."
            findings.append(check.warning("the mesh is tiny", f"{100 * longest:.2g} cm at most", fix))
        elif longest > HUGE_M:
            fix = "Is it in millimetres, or the whole scan?"
            findings.append(check.warning("the mesh is larger than an object", f"{longest:.3g} m", fix))
        # The hinge should be at an edge of the mesh, and limits set.
        check = Check(f"object {item.name}: freedom")
        if item.freedom.pivot is not None:
            low, high = item.box_world[:, :2]
            side = int((high - low).argmax())
            along = (item.freedom.pivot[side] - low[side]) / max(high[side] - low[side], 1e-9)
            if item.hinge_gap_m > HINGE_GAP_M:
                evidence = f"{100 * item.hinge_gap_m:.0f} cm from its box, from above"
                findings.append(check.warning("the hinge is beside the mesh", evidence, "Put the pivot at the hinge."))
            elif 0.3 < along < 0.7:
                evidence = f"at {100 * along:.0f} % of its longest side"
                findings.append(check.note("the hinge is in the middle", evidence, "Doors turn about an edge."))
        if item.freedom.kind in ("hinge", "axis") and item.freedom.limits is None:
            fix = "Set limits where they are known."
            findings.append(check.note("no limits", "it may turn or slide without end", fix))
    return findings + _check_floor(objects) + _check_overlaps(objects)


def _check_floor(objects: tuple[SceneObject, ...]) -> list[Finding]:
    """Sliding objects stand on one floor, and nothing is below it."""
    lowest = {item.name: float(item.box_world[0, 2]) for item in objects}
    standing = [lowest[item.name] for item in objects if item.freedom.kind == "plane"]
    if not standing:
        return []
    floor, found = float(np.median(standing)), []
    for item in objects:
        check, height = Check(f"object {item.name}: floor"), lowest[item.name] - floor
        if height < -FLOOR_M:
            evidence = f"{-100 * height:.0f} cm below what slides"
            fix = "Lift it, or cut the floor's points off its mesh."
            found.append(check.warning("reaches below the floor", evidence, fix))
        elif height > FLOOR_M and item.freedom.kind == "plane":
            evidence = f"{100 * height:.0f} cm above it"
            fix = "Another storey, or not an object that slides on the floor."
            found.append(check.note("slides above the others' floor", evidence, fix))
    return found


def _check_overlaps(objects: tuple[SceneObject, ...]) -> list[Finding]:
    """Pairs of objects with overlapping surfaces, or with one inside the other's bounding box."""
    boxes = np.array([item.box_world for item in objects])
    low, high = boxes[:, 0], boxes[:, 1]
    shared = np.maximum(
        np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None]) + SAME_SURFACE_M, 0
    ).prod(-1)
    volume = np.maximum(high - low + SAME_SURFACE_M, 0).prod(-1)
    found = []
    for a, b in np.argwhere(np.triu(shared > 0, 1)):
        inner, outer = (objects[k] for k in ((a, b) if volume[a] <= volume[b] else (b, a)))
        check = Check(f"objects {inner.name} and {outer.name}")
        # The share of the inner object's surface that coincides with the outer's.
        rng = np.random.default_rng(0)
        vertices, faces = inner.mesh.vertices.astype(np.float64), inner.mesh.faces
        if len(faces):
            corners = vertices[faces]
            area = np.linalg.norm(face_normals(corners), axis=1) + 1e-12
            sample = random_points(corners[rng.choice(len(faces), _SAMPLES, p=area / area.sum())], rng)
        else:
            sample = vertices[:: len(vertices) // _SAMPLES + 1]
        points = sample @ inner.R_world_object.double().numpy().T + inner.t_world_object.double().numpy()
        local = (points - outer.t_world_object.double().numpy()) @ outer.R_world_object.double().numpy()
        distance, _ = TriangleIndex.of(outer.mesh).nearest(np.ascontiguousarray(local))
        same = float((distance < SAME_SURFACE_M).mean())
        inside = float(shared[a, b] / min(volume[a], volume[b]))
        if same > _SAME_SHARE:
            evidence = f"{100 * same:.0f} % of the first's surface is within 2 cm of the second's"
            fix = "Was one object cut out twice? Remove one of them."
            found.append(check.warning("are at the same place", evidence, fix))
        elif inside > _INSIDE_SHARE:
            evidence = f"{100 * min(inside, 1):.0f} % of its own box"
            fix = "A chair under a table does; a sofa in a wardrobe does not."
            found.append(check.note("the first stands within the second's box", evidence, fix))
    return found
