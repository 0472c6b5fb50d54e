"""Effects of a recording: those that it calls for, those that one camera is looked through, and those in run.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from otsync.plugins import available
from recon.observe import EFFECTS
from recon.observe.effects import Effect, Params, Recorded


def all_effects() -> dict[str, type[Effect]]:
    """Every effect that there is, ours and others', by the name that the shell and run.json know it by."""
    effects = available("effects", EFFECTS)
    for name, kind in effects.items():
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise ValueError(
                f"effects: expected classes that inherit from recon.observe.Effect; found {name}: {kind!r}."
            )
    return effects


def with_declared(
    effects: Sequence[Effect],
    readouts: Sequence[float | None],
    gains: np.ndarray | None = None,
    falloff: tuple[float, float] | None = None,
) -> tuple[Effect, ...]:
    """``effects`` as a fit of these videos begins with them, and after them those that the recording calls for.

    An effect of a class stands for all that this class would add: a shutter among ``effects`` for what cameras declare.

    Args:
        readouts: that the videos' cameras declare. gains: (V,3) of the videos, where the static part tells them.
        falloff: of the cameras' vignetting, where it tells that.
    """
    recorded = Recorded(tuple(readouts), gains, falloff)
    begun = [effect.begun(recorded) for effect in effects]
    missing = [kind for kind in all_effects().values() if not any(isinstance(effect, kind) for effect in begun)]
    added = [effect for kind in missing if (effect := kind.called_for(recorded)) is not None]
    return (*begun, *added)


def optics(
    effects: Sequence[Effect], readout: float | None, video: int | None = None, learned: Params | None = None
) -> tuple[Effect, ...]:
    """The effects that one camera is looked through alone, as its video 0; what it declares is among them.

    Args:
        readout: that the camera declares. video: its place among those ``effects`` are of; None: none of them, so that
            only what holds for all is known of it. learned: parameters that the fit came to.
    """
    own = [alone for effect in effects if (alone := effect.alone(video, learned or {})) is not None]
    return with_declared(own, [readout])


def check_effects(effects: Sequence[Effect], times: np.ndarray, video: int | None = None) -> None:
    """ValueError for what cannot be of a video whose frames are at these seconds; video: as of :func:`optics`."""
    for effect in effects:
        if not effect.groups and (alone := effect.alone(video, {})) is not None:
            alone.check(times)


def kept(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Effects that :func:`optics` gave as run.json keeps them. ValueError for one that nothing would find again."""
    names = {kind: name for name, kind in all_effects().items()}
    unknown = [type(effect).__name__ for effect in effects if type(effect) not in names]
    if unknown:
        raise ValueError(
            f"effects: expected some of {', '.join(names.values())}; found {', '.join(unknown)}, which run.json cannot "
            'name. Add it with otsync.plugins.register("effects").'
        )
    return [{"name": names[type(effect)], **effect.kept()} for effect in effects]


def restored(kept: Iterable[Mapping[str, Any]]) -> tuple[Effect, ...]:
    """The effects that run.json keeps. ValueError or TypeError for what is none."""
    choices, effects = all_effects(), []
    for one in kept:
        name = one["name"]
        if name not in choices:
            raise ValueError(
                f"effects: expected some of {', '.join(choices)}; found {name!r}. Load the file that adds it "
                f"(--plugin)."
            )
        effects.append(choices[name].restored({k: v for k, v in one.items() if k != "name"}))
    return tuple(effects)
