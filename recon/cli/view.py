"""``otsync view``: a scene, or the tracks and clocks of a recording, in a browser on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

if TYPE_CHECKING:
    from recon.view.shown import Shown


@dataclass
class View:
    """Look at a finished reconstruction, or at a recording's tracks and matches in space, and move the clocks.

    Example: otsync view result

    A recording, synchronised first: otsync view recording/ --stages result/stages
    """

    what: tyro.conf.Positional[Path]
    """Folder that otsync run or recon fit wrote; or a recording: a scene.json, or a folder that holds one."""
    port: int = 8080
    """Of the server on this machine; where it is taken, another one."""
    stages: Path | None = None
    """Folder where the stages of a recording's synchronisation are kept, so that it is not done again."""
    allow_outside: bool = False
    """Let the scene of a recording name files outside its folder."""

    def run(self) -> int:
        from recon.view.window import check_port, require_viewer

        check_port(self.port)
        require_viewer()
        shown = self._shown()
        from recon.view.window import Window

        window = Window(shown, self.port)
        try:
            print(f"open {window.address} on this machine; Ctrl-C ends it", flush=True)
            window.wait()
        except KeyboardInterrupt:
            window.stop()
            print("closed")
        return 0

    def _shown(self) -> Shown:
        if (self.what / "run.json").is_file():
            from otsync.cli.tables import refuse_unused
            from recon.result.folder import load_result
            from recon.view.shown import OfScene

            refuse_unused(self, ("stages", "allow_outside"), "a finished reconstruction")
            result = load_result(self.what)
            return OfScene(result.scene, {video.name: video.camera for video in result.videos})
        from otsync.files.cache import Cache
        from otsync.progress import tell
        from otsync.recordings.routes import synchronize_scene
        from recon.cli.common import opened
        from recon.view.shown import OfTracks

        scene = opened(self.what, self.allow_outside)
        answer = synchronize_scene(scene, cache=Cache(self.stages), tell=tell)
        return OfTracks(answer.tracks, answer.offsets)
