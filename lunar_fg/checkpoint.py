"""What a run needs to go on that cannot be computed anew from its measurements."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from frontends.disparity_check import DisparityFinding
from frontends.landmark_memory import LandmarkMemory
from frontends.rectification import RectificationError
from frontends.templates import Templates
from lunar_fg.arrays import DAMAGED

_MEMORY = (
    "landmark_id", "descriptors", "laplacian", "points", "covariance", "unseen",
    "first_depth_m", "slope",
)  # fmt: skip
_TEMPLATES = ("pixels", "offset", "warp", "bend", "sigma_px")
_FINDING = ("field_px", "border_px", "border_sigma_px", "chance", "significant", "pairs")


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The state of the images' side after a frame.

    Attributes
    ----------
    memory, next_id
        Of the landmark tracker: the landmarks that may be seen again, with descriptors.
    rectification, vertical_measured
        What is corrected of the stereo pair, and whether its vertical field is known.
    images
        Digests of the last left and right image.
    watching
        Whether the disparity check still collects frames.
    watched_from
        The first keyframe that it looks at.
    finding
        What it found, once it has judged.
    corrected
        Whether the finding was applied.
    alignment
        How the images of the pair have moved against each other, see `lunar_fg.stereo_alignment`.
    """

    memory: LandmarkMemory | None = None
    next_id: int = 0
    rectification: RectificationError = field(default_factory=RectificationError)
    vertical_measured: bool = False
    images: tuple[bytes, bytes] | None = None
    watching: bool = True
    watched_from: int = 0
    finding: DisparityFinding | None = None
    corrected: bool = False
    alignment: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def to_bytes(self) -> bytes:
        """Pack it as a NumPy archive, bit for bit and without pickle."""
        arrays: dict[str, Any] = {
            "next_id": self.next_id,
            "watched_from": self.watched_from,
            "vertical_px": self.rectification.vertical_px,
            "disparity_px": self.rectification.disparity_px,
            "alignment": self.alignment,
            "flags": np.array([self.vertical_measured, self.watching, self.corrected]),
        }
        for group, names, part in (
            ("memory", _MEMORY, self.memory),
            ("templates", _TEMPLATES, None if self.memory is None else self.memory.templates),
            ("finding", _FINDING, self.finding),
        ):
            if part is not None:
                arrays |= {f"{group}_{name}": getattr(part, name) for name in names}
        if self.images is not None:
            arrays["images"] = np.frombuffer(b"".join(self.images), np.uint8)
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Unpack it.

        Raises
        ------
        ValueError, KeyError, OSError, EOFError
            It is damaged.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                arrays = dict(archive)
        except DAMAGED as error:
            raise ValueError(str(error)) from error
        vertical_measured, watching, corrected = map(bool, arrays["flags"])
        memory = finding = images = None
        if "images" in arrays:
            left, right = np.split(arrays["images"], 2)
            images = left.tobytes(), right.tobytes()
        if "memory_landmark_id" in arrays:
            templates = Templates(*(arrays[f"templates_{name}"] for name in _TEMPLATES))
            parts = {name: arrays[f"memory_{name}"] for name in _MEMORY}
            memory = LandmarkMemory(**parts, templates=templates)
        if "finding_pairs" in arrays:
            finding = DisparityFinding(
                arrays["finding_field_px"],
                arrays["finding_border_px"],
                arrays["finding_border_sigma_px"],
                float(arrays["finding_chance"]),
                bool(arrays["finding_significant"]),
                int(arrays["finding_pairs"]),
            )
        return cls(
            memory,
            int(arrays["next_id"]),
            RectificationError(arrays["vertical_px"], arrays["disparity_px"]),
            vertical_measured,
            images,
            watching,
            int(arrays["watched_from"]),
            finding,
            corrected,
            arrays["alignment"],
        )
