"""A live view of a run in Rerun (extra ``viz``): images, landmarks, path, ellipses, fixes.

Where there is a display a viewer opens; headless, everything goes to an ``.rrd`` file that
``rerun FILE`` opens later. Nothing of this is imported or computed unless it is asked for.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from frontends.errors import DependencyError
from frontends.geometry import transform_points
from frontends.measurements import AbsoluteFix, Estimate, FloatArray, StereoFrame, UnusableFrame
from lunar_fg.datasets.base import Dataset
from lunar_fg.georeference import Georeference
from lunar_fg.navigator import Navigator
from lunar_fg.orbital_picture import MapGrey, map_grey

_ESTIMATE, _LANDMARK = (79, 163, 255), (120, 200, 120)
_INLIER, _OUTLIER = (90, 220, 90), (230, 90, 60)
#: Half of the orbital map's side that is shown about the start, m.
_AROUND_M = 150.0
_QUANTILE_SIGMAS = 3.0


class LiveView:
    """Shows a run while it goes on.

    Parameters
    ----------
    dataset
        That the run goes through, for the orbital map.
    path
        ``.rrd`` file to write; None to open a viewer.

    Raises
    ------
    DependencyError
        Rerun is not installed.
    """

    def __init__(self, dataset: Dataset, path: Path | None) -> None:
        try:
            import rerun
            import rerun.blueprint
        except ImportError as error:
            raise DependencyError(
                'rerun-sdk is not installed; pip install "lunar-fg[viz]" brings it'
            ) from error
        self._rr: Any = rerun
        self._stream: Any = rerun.RecordingStream("lunar-fg")
        blueprint = _blueprint(rerun.blueprint)
        if path is None:
            self._stream.spawn(default_blueprint=blueprint)
        else:
            self._stream.save(path, default_blueprint=blueprint)
        self._path: list[FloatArray] = []
        self._fixes_shown = 0
        self._rover_T_camera = dataset.rover_T_camera
        self._stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._show_orbital(dataset)

    def observe(
        self, frame: StereoFrame | UnusableFrame, navigator: Navigator, estimate: Estimate
    ) -> None:
        """Show one frame and what came of it."""
        rr, stream = self._rr, self._stream
        stream.set_time("frame", sequence=estimate.index)
        stream.set_time("time", duration=estimate.stamp_s)
        if isinstance(frame, StereoFrame):
            stream.log("images/left", rr.Image(frame.left).compress(jpeg_quality=80))
            stream.log("images/right", rr.Image(frame.right).compress(jpeg_quality=80))
        else:
            stream.log("log", rr.TextLog(frame.reason, level="WARN"))
        pose = estimate.map_T_rover
        stream.log("map/rover", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        stream.log("map/rover/axes", rr.Arrows3D(
            vectors=np.eye(3), colors=[(200, 60, 50), (60, 160, 90), (40, 100, 180)]))  # fmt: skip
        self._path.append(pose[:3, 3])
        stream.log("map/path", rr.LineStrips3D([np.array(self._path)], colors=[_ESTIMATE]))
        self._show_ellipsoid(estimate)
        self._show_matches(navigator, pose)
        self._show_fixes(navigator)
        for name, count in _counts(navigator).items():
            stream.log(f"matches/{name}", rr.Scalars(count))
        sigmas = np.sqrt(np.maximum(np.diag(estimate.covariance)[3:], 0.0))
        for name, sigma in zip(("forward", "left", "up"), sigmas, strict=True):
            stream.log(f"sigma/{name}", rr.Scalars(sigma))
        for text in estimate.refused:
            stream.log("log", rr.TextLog(text, level="WARN"))

    def close(self) -> None:
        """Write what is still on its way."""
        self._stream.flush()
        self._stream.disconnect()

    def _show_matches(self, navigator: Navigator, pose: FloatArray) -> None:
        keyframe = navigator.keyframe
        if keyframe is None or keyframe.observations is None:
            return
        seen, relative = keyframe.observations, keyframe.relative
        inlier = np.zeros(len(seen), dtype=bool)
        if relative is not None:
            inlier = np.isin(seen.landmark_id, relative.inlier_ids)
        colours = np.where(inlier[:, None], _INLIER, _OUTLIER).astype(np.uint8)
        rr = self._rr
        for side, u in (("left", seen.u_left), ("right", seen.u_right)):
            points = np.column_stack([u, seen.v])
            self._stream.log(
                f"images/{side}/landmarks", rr.Points2D(points, colors=colours, radii=2.0)
            )
        first, second = (np.column_stack([u, seen.v]) for u in (seen.u_left, seen.u_right))
        ends = np.stack([first, second], axis=1)
        self._stream.log("images/left/disparity", rr.LineStrips2D(ends, colors=colours, radii=0.4))
        in_map = transform_points(pose @ self._rover_T_camera, seen.points_cam)
        self._stream.log("map/landmarks", rr.Points3D(in_map, colors=[_LANDMARK], radii=0.03))

    def _show_ellipsoid(self, estimate: Estimate) -> None:
        turn = estimate.map_T_rover[:3, :3]
        values, vectors = np.linalg.eigh(turn @ estimate.covariance[3:, 3:] @ turn.T)
        if np.linalg.det(vectors) < 0.0:
            vectors[:, 0] = -vectors[:, 0]
        rr = self._rr
        self._stream.log(
            "map/uncertainty",
            rr.Ellipsoids3D(
                centers=[estimate.map_T_rover[:3, 3]],
                half_sizes=[_QUANTILE_SIGMAS * np.sqrt(np.maximum(values, 0.0))],
                quaternions=[rr.Quaternion(xyzw=Rotation.from_matrix(vectors).as_quat())],
                colors=[_ESTIMATE],
            ),
        )

    def _show_fixes(self, navigator: Navigator) -> None:
        ledger = navigator.ledger
        if len(ledger) == self._fixes_shown:
            return
        self._fixes_shown = len(ledger)
        places, colours, labels = [], [], []
        for entry in ledger:
            fix = entry.measurement
            if not isinstance(fix, AbsoluteFix) or not fix.candidates:
                continue
            place = fix.candidates[entry.ruling.candidate or 0]
            places.append((place.x_m, place.y_m, fix.height_m or 0.0))
            believed = entry.ruling.verdict.value == "accepted"
            colours.append(_INLIER if believed else _OUTLIER)
            labels.append(f"{entry.frame}: {entry.ruling.reason}")
        rr = self._rr
        self._stream.log("map/fixes", rr.Points3D(places, colors=colours, labels=labels, radii=0.4))

    def _show_orbital(self, dataset: Dataset) -> None:
        found = _orbital(dataset)
        if found is None:
            return
        (left, right), (bottom, top) = found.x_m, found.y_m
        height = float(dataset.start.map_T_rover[2, 3]) - 0.5
        corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
        rr = self._rr
        self._stream.log(
            "map/orbital",
            rr.Mesh3D(
                vertex_positions=[(x, y, height) for x, y in corners],
                triangle_indices=[(0, 2, 1), (0, 3, 2)],
                vertex_texcoords=[(0, 0), (1, 0), (1, 1), (0, 1)],
                albedo_texture=np.repeat(found.pixels[..., None], 3, axis=-1),
            ),
            static=True,
        )


def open_live_view(dataset: Dataset, path: Path) -> LiveView:
    """Open a viewer where there is a display; write to `path` where there is none."""
    windowed = sys.platform in ("darwin", "win32")
    displayed = windowed or any(name in os.environ for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return LiveView(dataset, None if displayed else path)


def _orbital(dataset: Dataset) -> MapGrey | None:
    reference, orbital = dataset.map_reference, dataset.orbital
    if reference is None or orbital is None or orbital.ortho is None:
        return None
    georeference = Georeference.of(reference, dataset.path)
    start = dataset.start.map_T_rover[:2, 3]
    around = np.array([start - _AROUND_M, start + _AROUND_M])
    return map_grey(orbital.ortho, georeference, around[0], around[1])


def _counts(navigator: Navigator) -> dict[str, int]:
    if not navigator.reports:
        return {}
    report = navigator.reports[-1]
    return {
        "landmarks": report.landmarks,
        "tracked": report.tracked,
        "inliers": report.inliers,
    }


def _blueprint(rrb: Any) -> Any:
    """What is seen at first: the map large, images and figures beside it."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="map", name="Map"),
            rrb.Vertical(
                rrb.Horizontal(
                    rrb.Spatial2DView(origin="images/left", name="Left, with disparities"),
                    rrb.Spatial2DView(origin="images/right", name="Right"),
                ),
                rrb.TimeSeriesView(origin="matches", name="Matches"),
                rrb.TimeSeriesView(origin="sigma", name="1-sigma (m)"),
                rrb.TextLogView(origin="log", name="What was refused"),
                row_shares=[3, 2, 2, 1],
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
