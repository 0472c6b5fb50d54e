"""What a window draws of a moment, with viser's handles."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.view.shown import Moment, Shown

COLOURS = np.array(
    [(86, 180, 233), (230, 159, 0), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0), (0, 114, 178)],
    np.uint8,
)
"""Of the videos, in turn (Okabe and Ito)."""

DOT = 0.006
"""Size of a dot, as a share of the distance that the scene is looked at from."""

FAINT = 1e-4
"""Of a splat that stands for what is not there."""


class Drawing:
    """Draws on a server. Cameras and what stands still are drawn once; the rest is changed in place."""

    def __init__(self, server: Any, shown: Shown):
        self.server = server
        scene, (focus, far) = server.scene, shown.middle()
        self.far = far
        scene.set_up_direction(shown.up)
        side = np.array([far, 0.0, 0.0]) if abs(shown.up[0]) < 0.9 else np.array([0.0, far, 0.0])
        eyes = [c.center.reshape(-1, 3)[0] for c in shown.cameras.values()]
        server.initial_camera.position = tuple(map(float, eyes[0] if eyes else focus + side + 0.4 * far * shown.up))
        server.initial_camera.look_at = tuple(map(float, focus))
        server.initial_camera.up = tuple(map(float, shown.up))
        for v, camera in shown.cameras.items():
            self._frustum(v, shown.names[v], camera)
        self.still = None if shown.still is None else self._splats("/still", shown.still)
        self.moving: Any = None
        self.dots: dict[int, Any] = {}
        self.lines: Any = None

    def draw(self, moment: Moment) -> None:
        with self.server.atomic():
            if moment.splats is not None:
                if self.moving is None:
                    self.moving = self._splats("/moving", moment.splats)
                else:
                    s = moment.splats
                    self.moving.set_gaussians(s.centers, s.covariances, s.rgbs, s.opacities)
            for v in {*self.dots} - {*moment.dots}:
                self.dots.pop(v).remove()
            for v, points in moment.dots.items():
                colour = tuple(int(c) for c in COLOURS[v % len(COLOURS)])
                self.dots[v] = self.server.scene.add_point_cloud(
                    f"/videos/{v}", points.astype(np.float32), colour, point_size=DOT * self.far, point_shape="circle"
                )
            if self.lines is not None:
                self.lines.remove()
                self.lines = None
            if len(moment.lines):
                self.lines = self.server.scene.add_line_segments(
                    "/matches", moment.lines.astype(np.float32), (200, 200, 205), thickness=0.15 * DOT * self.far
                )

    def _splats(self, name: str, s: Any) -> Any:
        return self.server.scene.add_gaussian_splats(name, s.centers, s.covariances, s.rgbs, s.opacities)

    def _frustum(self, v: int, name: str, camera: Any) -> None:
        from recon.rotations import quaternions

        w2c = camera.w2c.reshape(-1, 4, 4)[0]
        fov = 2 * np.arctan(camera.height / (2 * camera.K[1, 1]))
        place = {
            "wxyz": tuple(map(float, quaternions(w2c[:3, :3].T))),
            "position": tuple(map(float, camera.center.reshape(-1, 3)[0])),
        }
        self.server.scene.add_camera_frustum(
            f"/cameras/{v}",
            float(fov),
            camera.width / camera.height,
            scale=0.07 * self.far,
            thickness=0.25 * DOT * self.far,
            color=tuple(int(c) for c in COLOURS[v % len(COLOURS)]),
            **place,
        )
        self.server.scene.add_label(f"/cameras/{v}/name", name)
