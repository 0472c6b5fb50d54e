"""``simulate()``: several unsynchronised videos of one moving scene, as the tracks a tracker would deliver."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..progress import counted
from ..types import Camera, TrackSet
from .adversaries import ADVERSARIES
from .body import sample_surface
from .effects import Effect, OwnFrame
from .features import FeatureModel
from .mocap import Mocap
from .observation import IDENTITY, Observation, Surface, stream
from .presets import PRESETS, Preset
from .scenes import MOTIONS, Scene
from .truth import Truth

Motion = str | Mocap | Scene | Callable[[np.random.Generator], Scene]


@dataclass(frozen=True)
class Rig:
    """Cameras on a circle around the scene, looking at its middle.

    Args:
        angle: degrees between neighbouring cameras.
        spread: degrees by which each deviates at random from its place.
        distance: m from the middle of the scene; None: the motion class's own (3.2, more for teams).
        height: m above the floor.
        focal, width, height_px: of the images, pixels.
        tilt: degrees, at most, by which each looks above or below the middle of the scene, at random.
    """

    angle: float = 40.0
    spread: float = 5.0
    distance: float | None = None
    height: float = 1.5
    focal: float = 720.0
    width: int = 1280
    height_px: int = 720
    tilt: float = 0.0

    def camera(self, scene: Scene, video: int, seed: int) -> Camera:
        """Camera of ``video``, in world coordinates."""
        rng = stream(seed, video, "camera")
        away = self.spread * rng.uniform(-1, 1)
        azimuth = stream(seed, "rig").uniform(0, 2 * np.pi) + np.radians(self.angle * video + away)
        distance = scene.distance if self.distance is None else self.distance
        center = np.array(scene.center)
        eye = center + distance * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        eye[2] = self.height
        z = center - eye
        if self.tilt:
            up = np.radians(self.tilt) * stream(seed, video, "tilt").uniform(-1, 1)
            z[2] = np.linalg.norm(z[:2]) * np.tan(np.arctan2(z[2], np.linalg.norm(z[:2])) + up)
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        w2c = np.eye(4)
        w2c[:3, :3] = np.stack([x, np.cross(z, x), z])
        w2c[:3, 3] = -w2c[:3, :3] @ eye
        K = np.array([[self.focal, 0, self.width / 2], [0, self.focal, self.height_px / 2], [0, 0, 1.0]])
        return Camera(K, w2c, self.width, self.height_px)


def simulate(
    motion: Motion = "juggle",
    *,
    preset: str | Preset = "mid",
    videos: int = 2,
    frames: int | Sequence[Any] = 150,
    fps: float | Sequence[float] = 30.0,
    tracks: int | Sequence[int] | None = None,
    offsets: Sequence[float] | None = None,
    max_offset: float = 30.0,
    rates: Sequence[float] | None = None,
    effects: tuple[Effect, ...] | None = None,
    rig: Rig | None = None,
    own_frames: bool = False,
    seed: int = 0,
) -> tuple[list[TrackSet], Truth]:
    """Draw a world and several videos of it, with exact answers.

    The world moves at every real time; each video sees points of its own on the surface that faces its camera, at
    ``t_world = rate * t + offset`` seconds: a positive offset means that it started later.

    Args:
        motion: a class of :data:`MOTIONS` ("boxes", "juggle", "softball", "tennis", "basketball", "football",
            "static"), a motion that misleads (:data:`ADVERSARIES`: "canon", "unison", "loop", "carousel", "belt",
            "flock"), ``"mocap:FILE"`` or a :class:`Mocap`, or a :class:`Scene` (or what draws one) of your own.
        preset: "clean", "mid", "hard", "brutal", or a :class:`Preset`.
        videos: how many; video 0 is the reference, with offset 0 and rate 1 unless given otherwise.
        frames: of every video, or one entry a video: a count, or the timestamps (T,) in seconds of a video whose frames
            are not evenly spaced.
        fps: frames per second of every video, or one a video.
        tracks: how many a video, or one a video; None: what the preset's matches take (1.6 of them, 2.4 for teams).
        offsets: seconds, one a video. None: drawn uniformly, up to ``max_offset`` frames of the reference, all after or
            all before the reference, so that no pair is further apart.
        max_offset: frames of the reference.
        rates: of the videos' clocks, one a video; None: all 1.
        effects: instead of the preset's; ``()`` gives exact positions.
        rig: where the cameras stand.
        own_frames: whether every video has a frame of reference of its own, in which it also gives its camera: after
            all other effects a random rotation, translation and scale (:class:`otsync.simulate.effects.OwnFrame`).
            Sets declare the frames "video0", "video1", ...; :meth:`Truth.transform` leads from one to another.
        seed: all randomness. A video's draw depends on the seed and its index, not on how many videos there are.

    Returns:
        One :class:`TrackSet` a video, with ``xyz`` nan where not visible, ``uv``, unit-norm ``features``, ``camera``
        and ``frame="world"`` (or their own); and the :class:`Truth`.

    >>> from otsync.simulate import simulate
    >>> tracks, truth = simulate("tennis", preset="clean", seed=3)
    >>> matches = truth.matches(0, 1)
    """
    level = _preset(preset)
    _check(videos, max_offset, seed)
    scene = _scene(motion, seed)
    clocks = _clocks(videos, frames, fps)
    figures = len(np.unique(scene.parts.object[scene.parts.figure]))
    counts = _per_video(level.tracks(figures) if tracks is None else tracks, videos, "tracks", int)
    given_rates = _per_video(1.0 if rates is None else rates, videos, "rates", float)
    if not all(np.isfinite(r) and r > 0 for r in given_rates):
        raise ValueError(f"rates: expected positive numbers; found {given_rates}. 1 is a clock like the world's.")
    seconds = _offsets(offsets, videos, max_offset / clocks[0][1], seed)
    used = (level.effects if effects is None else tuple(effects)) + ((OwnFrame(),) if own_frames else ())
    rig = rig or Rig()
    made = []
    for v in counted(range(videos), "simulating", "video"):
        obs = observe(
            scene,
            rig.camera(scene, v, seed),
            counts[v],
            *clocks[v],
            rate=given_rates[v],
            offset=seconds[v],
            features=level.features,
            seed=seed,
            video=v,
        )
        made.append(apply(obs, used, seed, v))
    names = [f"video{v}" for v in range(videos)]
    sets = [as_tracks(obs, name, name if own_frames else "world") for name, obs in zip(names, made, strict=True)]
    return sets, as_truth(scene, made, level, seed)


def observe(
    scene: Scene,
    camera: Camera,
    n: int,
    times: Float[np.ndarray, " T"],
    fps: float,
    regular: bool,
    *,
    rate: float,
    offset: float,
    features: FeatureModel | None,
    seed: int,
    video: int,
    dtype: type = np.float64,
) -> Observation:
    """What a perfect tracker sees: ``n`` points on the surface that faces ``camera``, at exact positions."""
    world_times = rate * times + offset
    poses = scene.pose(world_times)
    part, local, normal = _facing_points(scene, poses, camera, n, stream(seed, video, "surface"))
    position = scene.parts.body_coordinate(part, local)
    mirrored = position.copy()
    mirrored[scene.parts.figure[part], 0] *= -1
    surface = Surface(part, scene.parts.object[part], local, position, mirrored)
    xyz = _place(part, local, poses, dtype)

    def at(t: np.ndarray) -> np.ndarray:
        return _place(part, local, scene.pose(t), dtype)

    def facing(t: np.ndarray) -> np.ndarray:
        return _facing(part, local, normal, scene.pose(t), camera)

    described = None if features is None else features(surface, scene.parts, seed, video, dtype)
    return Observation(
        xyz,
        np.ones(xyz.shape[:2], bool),
        described,
        surface,
        times,
        regular,
        fps,
        rate,
        offset,
        camera,
        IDENTITY,
        scene_size(xyz),
        at,
        facing,
        video=video,
    )


def apply(obs: Observation, effects: tuple[Effect, ...], seed: int, video: int) -> Observation:
    """The effects one after the other, each with the stream of its name (and of its count, when repeated)."""
    seen: Counter[str] = Counter()
    for effect in effects:
        name = type(effect).__name__
        obs = effect(obs, stream(seed, video, "effect", name, seen[name]))
        seen[name] += 1
    return obs


def scene_size(xyz: Float[np.ndarray, "N T 3"]) -> float:
    """Median over time of the longest side of the box around all points, m; over at most 16 frames."""
    some = xyz[:, :: max(1, xyz.shape[1] // 16)]
    return float(np.median(np.ptp(some, axis=0).max(1)))


def _facing_points(
    scene: Scene, poses: tuple[np.ndarray, np.ndarray], camera: Camera, n: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " n"], np.ndarray, np.ndarray]:
    """``n`` random surface points that face the camera for at least half of the clip, as far as there are any."""
    frames = np.unique(np.linspace(0, poses[0].shape[1] - 1, 5).astype(int))
    some = poses[0][:, frames], poses[1][:, frames]
    part, local, normal = sample_surface(scene.parts, 3 * n + 16, rng)
    share = (_facing(part, local, normal, some, camera) > 0.1).mean(1)
    chosen = np.sort(np.argsort(-np.minimum(share, 0.5), kind="stable")[:n])
    return part[chosen], local[chosen], normal[chosen]


def _facing(
    part: np.ndarray, local: np.ndarray, normal: np.ndarray, poses: tuple[np.ndarray, np.ndarray], camera: Camera
) -> Float[np.ndarray, "N T"]:
    to_camera = camera.center - _place(part, local, poses, np.float64)
    turned = _place(part, normal, (poses[0], np.zeros_like(poses[1])), np.float64)
    return np.einsum("nti,nti->nt", turned, to_camera) / np.linalg.norm(to_camera, axis=2)


def _place(
    part: Int[np.ndarray, " N"], local: Float[np.ndarray, "N 3"], poses: tuple[np.ndarray, np.ndarray], dtype: type
) -> Float[np.ndarray, "N T 3"]:
    """Points of parts at the parts' poses: one small matrix product a part."""
    R, p = poses
    T = R.shape[1]
    xyz: np.ndarray = np.empty((len(part), T, 3), dtype)
    order = np.argsort(part, kind="stable")
    edges = np.searchsorted(part[order], np.arange(len(R) + 1))
    for i in np.flatnonzero(np.diff(edges)):
        own = order[edges[i] : edges[i + 1]]
        moved = local[own].astype(dtype) @ R[i].reshape(T * 3, 3).T.astype(dtype)
        moved += p[i].reshape(-1).astype(dtype)
        xyz[own] = moved.reshape(-1, T, 3)
    return xyz


def as_tracks(obs: Observation, name: str, frame: str | None, uv: bool = True) -> TrackSet:
    # nothing is seen behind the camera, nor on its lens
    forward, away = obs.camera.w2c[2, :3].astype(obs.xyz.dtype), obs.camera.w2c[2, 3]
    visible = obs.visible & (obs.xyz.reshape(-1, 3) @ forward + away > 0.05).reshape(obs.visible.shape)
    xyz = np.where(visible[..., None], obs.xyz, obs.xyz.dtype.type(np.nan))
    features = obs.features
    if features is not None:
        features = features / np.linalg.norm(features, axis=1, keepdims=True)
    return TrackSet(
        xyz,
        visible,
        features,
        fps=obs.fps,
        timestamps=None if obs.regular else obs.times,
        name=name,
        uv=obs.camera.project(xyz) if uv else None,
        camera=obs.camera,
        frame=frame,
    )


def as_truth(scene: Scene, made: list[Observation], level: Preset, seed: int) -> Truth:
    return Truth(
        offsets=np.array([obs.offset for obs in made]),
        rates=np.array([obs.rate for obs in made]),
        surfaces=tuple(obs.surface for obs in made),
        frames=tuple(obs.frame for obs in made),
        scene=scene,
        size=made[0].size,
        wrong=level.wrong,
        n_matches=level.matches,
        seed=seed,
        shown=tuple(obs.world_times for obs in made),
    )


def _preset(preset: str | Preset) -> Preset:
    if isinstance(preset, Preset):
        return preset
    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, or a Preset; found {preset!r}.")
    return PRESETS[preset]


def _scene(motion: Motion, seed: int) -> Scene:
    if isinstance(motion, Scene):
        return motion
    if isinstance(motion, str) and motion.startswith("mocap:"):
        motion = Mocap(motion.removeprefix("mocap:"))
    if isinstance(motion, str):
        known = MOTIONS | ADVERSARIES
        if motion not in known:
            raise ValueError(f"motion: expected one of {', '.join(known)}, mocap:FILE, or a Scene; found {motion!r}.")
        motion = known[motion]
    return motion(stream(seed, "motion"))


def _check(videos: int, max_offset: float, seed: int) -> None:
    if int(videos) < 1:
        raise ValueError(f"videos: expected at least 1; found {videos}.")
    if not (np.isfinite(max_offset) and max_offset >= 0):
        raise ValueError(f"max_offset: expected frames >= 0; found {max_offset}.")
    if int(seed) < 0:
        raise ValueError(f"seed: expected a number >= 0; found {seed}.")


def _is_one(value: Any) -> bool:
    """One value for all, rather than a sequence."""
    return not hasattr(value, "__len__")


def _per_video(value: Any, videos: int, name: str, kind: type) -> list[Any]:
    values = [value] * videos if _is_one(value) else list(value)
    if len(values) != videos:
        raise ValueError(f"{name}: expected one for all or one for each of {videos} videos; found {len(values)}.")
    if kind is int and not all(float(x) == int(x) and int(x) >= 1 for x in values):
        raise ValueError(f"{name}: expected whole numbers >= 1; found {values}.")
    return [kind(x) for x in values]


def _clocks(videos: int, frames: Any, fps: Any) -> list[tuple[np.ndarray, float, bool]]:
    """(times, fps, regular) of every video."""
    speeds = _per_video(fps, videos, "fps", float)
    if not all(np.isfinite(f) and f > 0 for f in speeds):
        raise ValueError(f"fps: expected frames per second > 0; found {speeds}.")
    entries = [frames] * videos if _is_one(frames) else list(frames)
    if len(entries) != videos:
        raise ValueError(f"frames: expected a number or one entry for each of {videos} videos; found {len(entries)}.")
    clocks = []
    for entry, speed in zip(entries, speeds, strict=True):
        if _is_one(entry):
            if float(entry) != int(entry) or int(entry) < 1:
                raise ValueError(f"frames: expected whole numbers >= 1, or timestamps in seconds; found {entry}.")
            clocks.append((np.arange(int(entry)) / speed, speed, True))
            continue
        times = np.asarray(entry, float)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise ValueError("frames: expected timestamps in seconds, finite and strictly increasing; these are not.")
        clocks.append((times, speed, False))
    return clocks


def _offsets(offsets: Sequence[float] | None, videos: int, furthest: float, seed: int) -> list[float]:
    if offsets is not None:
        seconds = _per_video(offsets, videos, "offsets", float)
        if not np.isfinite(seconds).all():
            raise ValueError(f"offsets: expected finite seconds; found {seconds}.")
        return seconds
    side = stream(seed, "offsets").choice([-1.0, 1.0])
    return [0.0] + [float(side * furthest * stream(seed, v, "offset").random()) for v in range(1, videos)]
