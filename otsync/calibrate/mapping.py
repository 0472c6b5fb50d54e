"""Structure from motion over the pictures, by pycolmap: features, matches, and two mappers that check each other.

A leaf: nothing else imports pycolmap, and it is imported when a mapping begins. SIFT only, no learned weights. One
thread and fixed seeds: the same pictures give the same cameras.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from ..files.digest import content_key
from ..progress import bar
from .clips import Lens
from .stills import Picture

Mapper = Literal["incremental", "global"]

NEAR = 6
"""Key frames of one clip that are matched with each other: those further apart see the same through other clips."""

FEATURES = {"stills": 8192, "clips": 3000}
"""Features of a picture. With few stills every one counts; a clip has many pictures."""

PEAK = {"stills": 0.0005, "clips": 0.004}
"""Thresholds of SIFT's peaks: low, for walls with thin texture (measured on the dome and in rooms)."""

EDGE = {"stills": 40.0, "clips": 10.0}
"""Ratios of curvatures up to which a peak is none of an edge. Of stills larger: on the dome the matches of right pairs
grew by half, those of wrong ones by a quarter."""


LEAST_OF_A_HALF = 8
"""Points that every picture must see when half of them are left out."""


@dataclass(frozen=True)
class Thresholds:
    """What a mapper asks for before it believes. Strict: on the dome looser ones added wrong cameras, no right ones.

    Args:
        matches: verified matches of a pair of pictures; of several numbers each is tried. pose: matches that agree on a
        new picture's pose, and share: which part of all of them that must be. first: matches of the first
        pair, and angle: degrees between its rays.
    """

    matches: tuple[int, ...] = (30, 45, 60, 80)
    pose: int = 30
    share: float = 0.25
    first: int = 40
    angle: float = 8.0


STILLS = Thresholds()
CLIPS = Thresholds(matches=(20,), pose=20)
"""Along a clip many pictures support each other."""


@dataclass(frozen=True, eq=False)
class Model:
    """What a mapper found, in its own frame and unit.

    Args:
        pictures: (P,) which pictures have a pose, as indices into the list that was mapped.
        w2c: (P,4,4) of these.
        focal, radial: (V,) focal length in pixels of each video's pictures, and k1; nan for a video without a pose.
        points: (M,3).
        seen: (O,2) indices into ``pictures`` and ``points``. uv: (O,2) pixels where the pictures see them.
        error: mean reprojection error in pixels.
        halves: (2,P,4,4) the same poses adjusted to either half of the points alone: how far they lie apart tells how
            sure the whole is. Empty where a half has too few points.
    """

    pictures: Int[np.ndarray, " P"]
    w2c: Float[np.ndarray, "P 4 4"]
    focal: Float[np.ndarray, " V"]
    radial: Float[np.ndarray, " V"]
    points: Float[np.ndarray, "M 3"]
    seen: Int[np.ndarray, "O 2"]
    uv: Float[np.ndarray, "O 2"]
    error: float
    halves: Float[np.ndarray, "2 P 4 4"] = field(default_factory=lambda: np.zeros((0, 0, 4, 4)))

    def arrays(self) -> dict[str, np.ndarray]:
        """For a cache."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> Model:
        """The inverse of :meth:`arrays`."""
        of: dict[str, Any] = {**arrays, "error": float(arrays["error"])}
        return cls(**of)

    @property
    def centres(self) -> Float[np.ndarray, "P 3"]:
        """Where the pictures were taken."""
        return -np.einsum("pji,pj->pi", self.w2c[:, :3, :3], self.w2c[:, :3, 3])


@dataclass(frozen=True, eq=False)
class Pictures:
    """All pictures of all videos, and the folder where their features are kept.

    Args:
        names: of the videos. of: (P,) which video each picture is of. pictures: (P,).
        lenses: (V,) at the pictures' size. moving: (V,) whether the camera moves.
        folder: where the database is kept, so that a killed run continues; a temporary one where None.
    """

    names: tuple[str, ...]
    of: Int[np.ndarray, " P"]
    pictures: tuple[Picture, ...]
    lenses: tuple[Lens, ...]
    moving: tuple[bool, ...]
    folder: Path | None = None
    _temporary: list[Any] = field(default_factory=list, repr=False)

    @property
    def kind(self) -> Literal["stills", "clips"]:
        return "clips" if any(self.moving) else "stills"

    @property
    def thresholds(self) -> Thresholds:
        return CLIPS if self.kind == "clips" else STILLS

    @property
    def key(self) -> str:
        """A hash of everything that features and matches follow from."""
        lenses = [(lens.K, lens.distortion, lens.source) for lens in self.lenses]
        pictures = [(p.image, p.use) for p in self.pictures]
        return content_key("sift 2", self.of, pictures, lenses, self.kind, NEAR, FEATURES, PEAK, EDGE)

    def file(self, p: int) -> str:
        """The name of picture ``p`` among the files: a folder a video, without the names that people give."""
        return f"{self.of[p]:04d}/{p:06d}.png"

    def database(self, tell: Any = lambda text: None) -> Path:
        """The features and verified matches of all pictures; made where they are not there yet."""
        folder = self.folder
        if folder is None:
            if not self._temporary:
                self._temporary.append(tempfile.TemporaryDirectory(prefix="otsync-calibrate-"))
            folder = Path(self._temporary[0].name)
        path = folder / f"features-{self.key}.db"
        if not path.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".pictures-", dir=folder) as work:
                part = Path(work) / "features.db"  # a killed run leaves no half of a database
                self._extract(part, Path(work), tell)
                os.replace(part, path)
        return path

    def _extract(self, path: Path, work: Path, tell: Any) -> None:
        import cv2
        import pycolmap

        for p, picture in enumerate(self.pictures):
            files = {work / "pictures" / self.file(p): picture.image[..., ::-1]}
            if picture.use is not None:  # a picture of a video with masks that has none is not read at all
                files[work / "masks" / f"{self.file(p)}.png"] = picture.use.astype(np.uint8) * 255
            for file, image in files.items():
                file.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(file), image)
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.use_gpu, extraction.num_threads = False, 1
        sift = extraction.sift
        sift.max_num_features, sift.peak_threshold = FEATURES[self.kind], PEAK[self.kind]
        sift.edge_threshold = EDGE[self.kind]
        if self.kind == "stills":
            sift.estimate_affine_shape, sift.domain_size_pooling = True, True
        else:
            sift.first_octave = 0
        with quiet(pycolmap):
            for v in range(len(self.names)):
                names = [self.file(int(p)) for p in np.flatnonzero(self.of == v)]
                reader = pycolmap.ImageReaderOptions()
                reader.camera_model, reader.camera_params = colmap_camera(self.lenses[v])
                if any(self.pictures[int(p)].use is not None for p in np.flatnonzero(self.of == v)):
                    reader.mask_path = str(work / "masks")
                mode, device = pycolmap.CameraMode.PER_FOLDER, pycolmap.Device.cpu
                pycolmap.extract_features(path, work / "pictures", names, mode, reader, extraction, device)
                tell(f"features {v + 1}/{len(self.names)}: {self.names[v]}, {len(names)} pictures")
            pairs = self.pairs()
            listed = work / "pairs.txt"
            listed.write_text("".join(f"{self.file(a)} {self.file(b)}\n" for a, b in pairs))
            matching = pycolmap.FeatureMatchingOptions()
            matching.use_gpu, matching.num_threads = False, 1
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path = str(listed)
            geometry = pycolmap.TwoViewGeometryOptions()
            geometry.detect_watermark = False
            geometry.ransac.random_seed = 0
            pycolmap.match_image_pairs(path, matching, pairing, geometry, pycolmap.Device.cpu)
        tell(f"matches: {len(pairs)} pairs of pictures")

    def pairs(self) -> list[tuple[int, int]]:
        """Which pictures are compared: those of two videos, and near ones of one."""
        n = len(self.pictures)
        return [
            (a, b)
            for a in range(n)
            for b in range(a + 1, n)
            if self.of[a] != self.of[b] or (self.moving[int(self.of[a])] and b - a <= NEAR)
        ]

    def matches(self) -> dict[tuple[int, int], Float[np.ndarray, "N 4"]]:
        """Verified matches of every pair of pictures that has any: pixels (u, v) in the one, then in the other."""
        import pycolmap

        with quiet(pycolmap), opened(pycolmap, self.database()) as database:
            index = {image.image_id: int(image.name.split("/")[1][:6]) for image in database.read_all_images()}
            uv = {p: database.read_keypoints(image)[:, :2].astype(float) for image, p in index.items()}
            ids, counts = database.read_two_view_geometry_num_inliers()
            found = {}
            for pair, count in zip(ids, counts, strict=True):
                one, two = pair if isinstance(pair, tuple | list) else pycolmap.pair_id_to_image_pair(pair)
                if not count:
                    continue
                same = np.asarray(database.read_two_view_geometry(one, two).inlier_matches, int)
                a, b = index[one], index[two]
                seen = np.concatenate([uv[a][same[:, 0]], uv[b][same[:, 1]]], 1)
                found[min(a, b), max(a, b)] = seen if a < b else seen[:, [2, 3, 0, 1]]
            return found


def map_pictures(pictures: Pictures, mapper: Mapper, *, least: int, refine: bool, seed: int = 0) -> Model | None:
    """The largest model that a mapper makes; None where it makes none.

    Args:
        least: verified matches of the pairs that it heeds (see :class:`Thresholds`).
        refine: whether focal lengths and radial distortion of lenses that are not known are found too.
        seed: of its random numbers.
    """
    import pycolmap

    source = pictures.database()
    thresholds = pictures.thresholds
    with quiet(pycolmap), tempfile.TemporaryDirectory(prefix="otsync-mapping-") as work:
        path = Path(work) / "features.db"
        shutil.copy(source, path)
        with opened(pycolmap, path) as database:
            folders = {image.camera_id: int(image.name[:4]) for image in database.read_all_images()}
            given = {camera: np.array(database.read_camera(camera).params) for camera in folders}
        held = {camera for camera, v in folders.items() if not refine or pictures.lenses[v].known}
        make = _incremental if mapper == "incremental" else _global
        try:
            found = make(pycolmap, path, Path(work), thresholds, least=least, refine=refine, held=held, seed=seed)
        except (RuntimeError, ValueError):  # COLMAP's own checks: too little to map
            return None
        if not found:
            return None
        best = max(found.values(), key=lambda r: (r.num_reg_images(), r.num_points3D()))
        if best.num_reg_images() < 2 or best.num_points3D() < thresholds.pose:
            return None
        for camera in held & set(best.cameras):  # the global mapper refines all lenses or none
            best.cameras[camera].params = given[camera]
        adjust(pycolmap, best, held)
        return replace(_model(best, pictures, folders), halves=_halves(pycolmap, best, held, Path(work)))


def _incremental(
    pycolmap: Any,
    path: Path,
    work: Path,
    thresholds: Thresholds,
    *,
    least: int,
    refine: bool,
    held: set[int],
    seed: int,
) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = 1, seed, False
    options.min_model_size, options.multiple_models = 2, False
    options.min_num_matches = least
    options.ba_refine_focal_length = options.ba_refine_extra_params = refine
    options.constant_cameras = held
    options.triangulation.ignore_two_view_tracks = False
    mapper = options.mapper
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = refine
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = thresholds.pose, thresholds.share
    mapper.abs_pose_max_error = 8.0
    mapper.init_min_num_inliers, mapper.init_min_tri_angle = thresholds.first, thresholds.angle
    with bar("mapping", "picture") as shown:

        def placed() -> None:
            shown.update()

        return pycolmap.incremental_mapping(path, work, work, options, next_image_callback=placed)


def _global(
    pycolmap: Any,
    path: Path,
    work: Path,
    thresholds: Thresholds,
    *,
    least: int,
    refine: bool,
    held: set[int],
    seed: int,
) -> Any:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = 1, seed, 2
    options.min_num_matches = least
    mapper = options.mapper
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.refine_focal_length = mapper.bundle_adjustment.refine_extra_params = refine
    return pycolmap.global_mapping(path, work, work, options)


def adjust(pycolmap: Any, model: Any, held: set[int]) -> None:
    """Bundle adjustment of all of a model, robust against what still moves in it; lenses in ``held`` stay."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    for camera in model.cameras:
        if camera in held:
            config.set_constant_cam_intrinsics(camera)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def _halves(pycolmap: Any, model: Any, held: set[int], work: Path) -> Float[np.ndarray, "2 P 4 4"]:
    """The poses of a model adjusted to every other of its points, and to the others."""
    kept = work / "whole"
    kept.mkdir()
    model.write(kept)
    found = []
    for half in (0, 1):
        part = pycolmap.Reconstruction(kept)
        for point in sorted(part.points3D)[half::2]:
            part.delete_point3D(point)
        adjust(pycolmap, part, held)
        images = sorted((image.name, image) for image in part.images.values() if image.has_pose)
        if any(sum(p.has_point3D() for p in image.points2D) < LEAST_OF_A_HALF for _, image in images):
            return np.zeros((0, 0, 4, 4))
        w2c = np.tile(np.eye(4), (len(images), 1, 1))
        for n, (_, image) in enumerate(images):
            w2c[n, :3] = image.cam_from_world().matrix()
        found.append(w2c)
    return np.stack(found)


def _model(model: Any, pictures: Pictures, folders: Mapping[int, int]) -> Model:
    """A reconstruction as arrays."""
    images = sorted(
        (int(image.name.split("/")[1][:6]), image) for image in model.images.values() if image.has_pose
    )  # by picture
    points = sorted(model.points3D)
    at = {point: n for n, point in enumerate(points)}
    w2c, seen, uv = np.tile(np.eye(4), (len(images), 1, 1)), [], []
    for n, (_, image) in enumerate(images):
        w2c[n, :3] = image.cam_from_world().matrix()
        for observed in image.points2D:
            if observed.has_point3D():
                seen.append((n, at[observed.point3D_id]))
                uv.append(observed.xy)
    focal = np.full(len(pictures.names), np.nan)
    radial = np.zeros(len(pictures.names))
    mapped = {image.camera_id for _, image in images}
    for camera, v in folders.items():
        if camera in mapped:
            focal[v] = model.cameras[camera].params[0]
            if not pictures.lenses[v].known:
                radial[v] = model.cameras[camera].params[3]
    return Model(
        np.array([p for p, _ in images]),
        w2c,
        focal,
        radial,
        np.array([model.points3D[point].xyz for point in points]).reshape(-1, 3),
        np.array(seen, int).reshape(-1, 2),
        np.array(uv, float).reshape(-1, 2),
        float(model.compute_mean_reprojection_error()),
    )


def colmap_camera(lens: Lens) -> tuple[str, str]:
    """COLMAP's name of a lens's model and its parameters. A lens that is not known has a radial term to be found.

    COLMAP's pixels are ours (the centre of the first at 0.5), and its distortion is OpenCV's.
    """
    K = lens.K
    if not lens.known:
        return "SIMPLE_RADIAL", ",".join(map(repr, map(float, (K[0, 0], K[0, 2], K[1, 2], 0.0))))
    pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    bends = np.zeros(4) if lens.distortion is None else np.asarray(lens.distortion, float)
    if not bends.any():
        return "PINHOLE", ",".join(repr(float(x)) for x in pinhole)
    if len(bends) == 4 or not bends[4:].any():
        return "OPENCV", ",".join(repr(float(x)) for x in [*pinhole, *bends[:4]])
    return "FULL_OPENCV", ",".join(repr(float(x)) for x in [*pinhole, *np.pad(bends, (0, 8 - len(bends)))])


def found_camera(lens: Lens) -> dict[str, Any]:
    """A lens after the mapping, with the radial term that was found, as COLMAP and poselib name its parts."""
    name, parameters = colmap_camera(lens)
    values = [float(x) for x in parameters.split(",")]
    if name == "SIMPLE_RADIAL" and lens.distortion is not None:
        values[3] = float(lens.distortion[0])
    width, height = (max(1, round(2 * float(c))) for c in lens.K[:2, 2])  # nobody reads them for poses
    return {"model": name, "width": width, "height": height, "params": values}


@contextmanager
def opened(pycolmap: Any, path: Path) -> Any:
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


@contextmanager
def quiet(pycolmap: Any) -> Any:
    """COLMAP writes its own story to stderr; errors come as exceptions."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def lenses_found(model: Model, lenses: Sequence[Lens]) -> tuple[Lens, ...]:
    """The lenses after a mapping: those that were not known with the focal length and radial term that it found."""
    found = []
    for lens, focal, radial in zip(lenses, model.focal, model.radial, strict=True):
        if lens.known or not np.isfinite(focal):
            found.append(lens)
            continue
        K = lens.K.copy()
        moved = abs(focal - K[0, 0]) > 1e-9 * focal
        K[0, 0] = K[1, 1] = focal
        bends = np.array([radial, 0, 0, 0]) if radial else None
        found.append(Lens(K, bends, "found" if moved else lens.source))
    return tuple(found)
