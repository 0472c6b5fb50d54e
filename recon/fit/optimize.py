"""Learning rates per parameter group, their decay, and the optimiser that a fit steps.

A group without a rate is frozen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from recon.observe import EFFECTS
from recon.observe.recorded import all_effects
from recon.scene import groups
from recon.scene.groups import Group, by_name, initial_rates

DECLARED = by_name((*groups.SCENE, *(g for e in EFFECTS for g in e.groups), *groups.CLOCKS))
"""Our own parameter groups by name: a scene's, the effects', the clocks'."""

RATES: Mapping[str, float] = initial_rates(DECLARED.values())
"""Adam's steps at the start of our own groups, in the groups' units: see :mod:`recon.scene.groups`."""


def without(rates: Mapping[str, float], *frozen: str) -> dict[str, float]:
    """``rates`` with some groups frozen. ValueError for a name that has no rate anyway."""
    unknown = [g for g in frozen if g not in rates]
    if unknown:
        raise ValueError(f"freeze: expected some of {', '.join(rates)}; found {', '.join(unknown)}.")
    return {name: rate for name, rate in rates.items() if name not in frozen}


@dataclass(frozen=True)
class Decay:
    """Constant for the first ``hold`` of all steps, then exponential down to ``last`` of the rate at the end.

    What decides the last hundredths of a frame is this decay: at full rate the offsets jitter by .03 to .04.
    """

    hold: float = 0.35
    last: float = 0.05

    def __call__(self, progress: float) -> float:
        """The factor at ``progress`` 0..1 of the fit."""
        return float(self.last ** max(0.0, (progress - self.hold) / (1 - self.hold)))


def rates_on(option: str) -> Any:
    """Tells the shell to take rates as GROUP=RATE; groups that are not named keep their initial rates."""
    from tyro.constructors import PrimitiveConstructorSpec

    def parsed(texts: list[str]) -> dict[str, float]:
        rates = initial_rates(every_group().values())
        for text in texts:
            name, _, rate = text.partition("=")
            try:
                rates[name] = float(rate)
            except ValueError:
                raise ValueError(f"{option}: expected GROUP=RATE; found {text!r}.") from None
        return rates

    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="[GROUP=RATE ...]",
        instance_from_str=parsed,
        is_instance=lambda given: given is None or isinstance(given, Mapping),
        str_from_instance=lambda rates: [f"{k}={v:g}" for k, v in (RATES if rates is None else rates).items()],
    )


def every_group() -> dict[str, Group]:
    """Our own parameter groups, and those of every effect that there is."""
    return DECLARED | by_name(group for effect in all_effects().values() for group in effect.groups)


def chosen_rates(rates: Mapping[str, float] | None, declared: Mapping[str, Group]) -> dict[str, float]:
    """The rates that somebody chose: those that differ from what the groups begin with."""
    usual = initial_rates(declared.values())
    return {name: rate for name, rate in (rates or {}).items() if rate != usual.get(name)}


def check_there(option: str, names: Iterable[str], groups: Mapping[str, Tensor]) -> None:
    """ValueError for names of an option that are no groups of this fit, so that it would not heed them."""
    there = [name for name, values in groups.items() if values.numel()]
    absent = [name for name in names if name not in there]
    if absent:
        raise ValueError(
            f"{option}: expected groups of this fit ({', '.join(there)}); found {', '.join(absent)}, which it does not "
            "have. Leave them out."
        )


def check_rates(rates: Mapping[str, float], groups: Mapping[str, Tensor]) -> dict[str, float]:
    """Rates of the groups that there are. ValueError for names that no model has, and for negative rates."""
    known = set(groups) | set(every_group())
    unknown = [name for name in rates if name not in known]
    if unknown:
        raise ValueError(f"rates: expected groups among {', '.join(sorted(known))}; found {', '.join(unknown)}.")
    bad = {name: rate for name, rate in rates.items() if not 0 < rate < float("inf")}
    if bad:
        raise ValueError(f"rates: expected positive numbers; found {bad}. Leave a group out to freeze it.")
    return {name: rate for name, rate in rates.items() if name in groups and groups[name].numel()}


class Adam:
    """torch's Adam over named groups; steps are given in the groups' own units, and its state is plain tensors."""

    BETAS = (0.9, 0.99)

    def __init__(
        self,
        groups: Mapping[str, Tensor],
        rates: Mapping[str, float],
        footprint: float,
        frame_step: float,
        declared: Mapping[str, Group] = DECLARED,
    ):
        """declared: what tells the units of the rates, by group; one that is not declared is stepped as it is."""

        def unit(name: str) -> float:
            return declared[name].scale(footprint, frame_step) if name in declared else 1.0

        self.rates = {name: rate * unit(name) for name, rate in rates.items()}
        # torch's fused CPU kernel walks parameters and gradients as flat memory: strides of their own would scramble
        # them
        self.groups = {
            name: groups[name].detach().clone(memory_format=torch.contiguous_format).requires_grad_()
            for name in self.rates
        }
        self._adam = torch.optim.Adam(
            [{"params": [p], "lr": self.rates[name], "name": name} for name, p in self.groups.items()],
            betas=self.BETAS,
            eps=1e-15,
            fused=True,
        )

    def step(self, gradients: Mapping[str, Tensor], factor: float) -> None:
        """One step with every rate times ``factor``. A group without a gradient stands still."""
        for group in self._adam.param_groups:
            group["lr"] = self.rates[group["name"]] * factor
            gradient = gradients.get(group["name"])
            self.groups[group["name"]].grad = None if gradient is None else gradient.contiguous()
        self._adam.step()

    def moments(self) -> dict[str, Tensor]:
        """Adam's averages and step counts by group: what a checkpoint needs besides the parameters."""
        out = {}
        for name, p in self.groups.items():
            for key, value in self._adam.state.get(p, {}).items():
                out[f"{name}.{key}"] = value
        return out

    def restore(self, moments: Mapping[str, Tensor]) -> None:
        """Put back what :meth:`moments` gave."""
        for name, p in self.groups.items():
            own = {key[len(name) + 1 :]: v for key, v in moments.items() if key.rpartition(".")[0] == name}
            if own:
                self._adam.state[p] = {key: v.to(p.device, copy=True) for key, v in own.items()}
