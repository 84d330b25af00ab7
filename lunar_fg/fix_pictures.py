"""Pictures of a fix: what the rover saw, what was looked for, where it was found.

Small and quickly made: a run draws every attempt as it goes, the report shows them, and
`lunar-fg locate` draws the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.absolute import Adjustment, Proposal
from frontends.errors import InputError
from frontends.terrain import Grid
from lunar_fg.run_folder import write_whole

Picture = NDArray[np.uint8]

#: Side of a panel and height of its title, px.
_SIDE, _TITLE, _GAP = 240, 20, 6
_PAPER, _INK = 250, (60, 60, 60)
#: Blue, green, red: where the patch was expected, and where it was found.
_EXPECTED, _FOUND = (60, 130, 230), (90, 170, 40)


@dataclass(frozen=True, slots=True)
class FixPictures:
    """Draws attempts into a folder, one JPEG a keyframe."""

    folder: Path

    def path(self, frame: int) -> Path:
        """Where the picture of a keyframe's fix is."""
        return self.folder / f"fix_{frame:06d}.jpg"

    def draw(self, adjustment: Adjustment) -> None:
        """Write the picture of an attempt.

        Raises
        ------
        InputError
            The folder cannot be written.
        """
        _, code = cv2.imencode(".jpg", picture_of(adjustment), [cv2.IMWRITE_JPEG_QUALITY, 85])
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            problem = f"cannot be written: {error.strerror}"
            raise InputError(problem, source=self.folder) from error
        write_whole(self.path(adjustment.fix.frame), code.tobytes())


def picture_of(adjustment: Adjustment) -> Picture:
    """Panels in a row, (H, W, 3), blue, green, red.

    The rover's own image of the ground, its relief without rocks, that relief as it was looked
    for, the part of the map that was searched with the patch's outline where it was found, and
    the correlation at the best yaw. What there is not is left white.

    Parameters
    ----------
    adjustment
        From `frontends.absolute`.
    """
    patch, fix = adjustment.patch, adjustment.fix
    shown = _shown(adjustment)
    template = None if shown is None else shown.template
    panels = [
        _panel("seen by the rover", None if patch is None else _grey(patch.ortho)),
        _panel("its relief", None if patch is None else _coloured(patch.height_m)),
        _panel("as looked for", None if template is None else _grey(template)),
        _panel("map: expected, found" if fix.candidates else "map", _searched(adjustment, shown)),
        _panel("correlation", _surface(shown)),
    ]
    gap = np.full((panels[0].shape[0], _GAP, 3), _PAPER, np.uint8)
    row = [part for panel in panels for part in (panel, gap)][:-1]
    return np.hstack(row)


def _shown(adjustment: Adjustment) -> Proposal | None:
    """The method that found the best place; else the first that compared anything."""
    if adjustment.fix.candidates:
        best = adjustment.fix.candidates[0].proposer
        for proposal in adjustment.proposals:
            if proposal.proposer == best:
                return proposal
    return next((p for p in adjustment.proposals if p.window is not None), None)


def _searched(adjustment: Adjustment, shown: Proposal | None) -> Picture | None:
    if shown is None or shown.window is None or adjustment.patch is None:
        return None
    patch, grid = adjustment.patch, shown.window.grid
    image, scale = _fitted(_grey(shown.window.values))
    cv2.drawMarker(image, _pixel(grid, scale, patch.x_m, patch.y_m), _EXPECTED,
                   cv2.MARKER_CROSS, 14, 2)  # fmt: skip
    if adjustment.fix.candidates:
        best = adjustment.fix.candidates[0]
        inner = cv2.erode(patch.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rows, columns = np.nonzero(patch.mask & ~inner)
        u, v = patch.grid.place(columns.astype(np.float64), rows.astype(np.float64))
        u, v = u - patch.x_m, v - patch.y_m
        c, s = np.cos(best.yaw_rad - patch.yaw_rad), np.sin(best.yaw_rad - patch.yaw_rad)
        for x, y in zip(best.x_m + c * u - s * v, best.y_m + s * u + c * v, strict=True):
            cv2.circle(image, _pixel(grid, scale, float(x), float(y)), 1, _FOUND, -1)
        cv2.drawMarker(image, _pixel(grid, scale, best.x_m, best.y_m), _FOUND,
                       cv2.MARKER_TILTED_CROSS, 14, 2)  # fmt: skip
    return image


def _surface(shown: Proposal | None) -> Picture | None:
    if shown is None or shown.volume is None or not shown.volume.values.size:
        return None
    values = np.where(np.isfinite(shown.volume.values), shown.volume.values, -1.0)
    return _coloured(values.max(axis=0))


def _pixel(grid: Grid, scale: float, x_m: float, y_m: float) -> tuple[int, int]:
    column, row = grid.pixel(np.array(x_m), np.array(y_m))
    return round((float(column) + 0.5) * scale), round((float(row) + 0.5) * scale)


def _grey(values: NDArray[Any]) -> Picture:
    level = _level(values)
    level[~np.isfinite(values)] = _PAPER
    return np.repeat(level[:, :, None], 3, axis=2)


def _coloured(values: NDArray[Any]) -> Picture:
    colours = np.asarray(cv2.applyColorMap(_level(values), cv2.COLORMAP_VIRIDIS), np.uint8)
    colours[~np.isfinite(values)] = _PAPER
    return colours


def _level(values: NDArray[Any]) -> Picture:
    """0 to 255 over all but the extreme hundredths of the known values."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [1.0, 99.0]) if known.size else (0.0, 1.0)
    share = (np.nan_to_num(values) - low) / max(float(high - low), 1e-12)
    return np.asarray(np.clip(255.0 * share, 0.0, 255.0), np.uint8)


def _fitted(image: Picture) -> tuple[Picture, float]:
    """Scaled so that its longer side fills a panel, and the scale."""
    scale = _SIDE / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    how = cv2.INTER_NEAREST if scale > 1.0 else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, size, interpolation=how), np.uint8), scale


def _panel(title: str, image: Picture | None) -> Picture:
    panel = np.full((_SIDE + _TITLE, _SIDE, 3), _PAPER, np.uint8)
    cv2.putText(panel, title, (3, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    if image is not None:
        fitted, _ = _fitted(image)
        top = _TITLE + (_SIDE - fitted.shape[0]) // 2
        left = (_SIDE - fitted.shape[1]) // 2
        panel[top : top + fitted.shape[0], left : left + fitted.shape[1]] = fitted
    return panel
