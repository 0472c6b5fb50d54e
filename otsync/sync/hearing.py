"""Where the hearing of all pairs stands: their answers, what is judged of them, and the clocks that were mended."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from ..compute.threads import MapLike
from ..types import Break, TrackSet
from .graph import Pair
from .pairs import Job, run
from .verdict import Answer, Verdict

Judge = Callable[[Sequence[Answer], Sequence[TrackSet]], Verdict]
"""Makes a verdict of the answers of all pairs, and of the tracks that pairs which contradict are fitted anew with."""


@dataclass(frozen=True, eq=False)
class Hearing:
    """What is known of all pairs; each step of a synchronisation makes the next one of it.

    Args:
        jobs: the work on every pair. verdict: of their answers.
        tracks: of every video, on its clock as far as it was mended; those of the jobs.
        broken: of the videos that were mended the breaks, on each one's own clock.
        judge: makes a verdict. map: as in :func:`otsync.synchronize`.
    """

    jobs: tuple[Job, ...]
    verdict: Verdict
    tracks: tuple[TrackSet, ...]
    broken: Mapping[int, tuple[Break, ...]]
    judge: Judge
    map: MapLike

    @classmethod
    def begun(cls, jobs: Sequence[Job], tracks: Sequence[TrackSet], judge: Judge, map: MapLike) -> Hearing:
        """All pairs answered for the first time."""
        verdict = judge(list(map(run, jobs)), tracks)
        return cls(tuple(jobs), verdict, tuple(tracks), {}, judge, map)

    @property
    def answers(self) -> tuple[Answer, ...]:
        """One for each pair."""
        return self.verdict.answers

    def judged(self, answers: Sequence[Answer]) -> Hearing:
        """The hearing with the verdict of these answers."""
        return replace(self, verdict=self.judge(answers, self.tracks))

    def told(self, fresh: Mapping[Pair, Answer]) -> Hearing:
        """The hearing, with these answers in place of those that the pairs had."""
        return self.judged([fresh.get(a.pair, a) for a in self.answers]) if fresh else self

    def doubted(self, pairs: Collection[Pair]) -> Hearing:
        """The hearing, with the doubt in these pairs that a clock breaks."""
        return self.told({a.pair: a.doubted() for a in self.answers if a.pair in pairs})

    def doubted_videos(self, videos: Collection[int]) -> Hearing:
        """The hearing, with the doubt in all pairs of these videos that a clock breaks."""
        return self.doubted([a.pair for a in self.answers if not set(videos).isdisjoint(a.pair)])

    def of(self, video: int) -> list[Job]:
        """The work on the pairs of a video."""
        return [job for job in self.jobs if video in job.pair]

    def mended(self, video: int, tracks: TrackSet, broke: Break) -> Hearing:
        """The hearing, with a video on a mended clock; its pairs still have the answers that they had before.

        Args:
            tracks: on the mended clock. broke: what was mended, as told on the clock that the video had before.
        """
        every = tuple(tracks if v == video else t for v, t in enumerate(self.tracks))
        jobs = tuple(replace(j, a=every[j.pair[0]], b=every[j.pair[1]]) for j in self.jobs)
        earlier = self.broken.get(video, ())
        broken = {**self.broken, video: (*earlier, on_own_clock(broke, earlier))}
        return replace(self, jobs=jobs, tracks=every, broken=broken)


def on_own_clock(found: Break, earlier: Sequence[Break]) -> Break:
    """A break that was found on a mended clock, told in the video's own time."""
    late = sum(b.jump for b in earlier if b.at + b.jump <= found.at)
    return replace(found, at=found.at - late)
