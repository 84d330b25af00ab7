"""What a run was made from, kept beside its results so that products can be made later."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, ValidationError

from frontends.errors import InputError
from lunar_fg.datasets.base import Dataset, MapReference
from lunar_fg.run_folder import RunFolder, write_whole


class RunSource(BaseModel):
    """Where the images and maps of a run lie, and what its map frame is.

    Attributes
    ----------
    name
        Of the dataset.
    dataset, images, traverse, calibration
        What `lunar_fg.datasets.open_dataset` was given, absolute.
    crs, origin_m
        Of the map frame; None for a local frame.
    ortho, dem
        Orbital maps, absolute paths.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str
    dataset: Path
    images: Path | None = None
    traverse: Path | None = None
    calibration: tuple[Path, ...] = ()
    crs: str | None = None
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ortho: Path | None = None
    dem: Path | None = None

    @classmethod
    def of(
        cls,
        dataset: Dataset,
        images: Path | None = None,
        traverse: Path | None = None,
        ortho: Path | None = None,
        dem: Path | None = None,
        calibration: Sequence[Path] = (),
    ) -> Self:
        """Source of a run over `dataset`; `ortho` and `dem` replace the dataset's own maps."""
        reference, orbital = dataset.map_reference, dataset.orbital
        if orbital is not None:
            ortho, dem = ortho or orbital.ortho, dem or orbital.dem
        return cls(
            name=dataset.name,
            dataset=dataset.path.resolve(),
            images=None if images is None else images.resolve(),
            traverse=None if traverse is None else traverse.resolve(),
            calibration=tuple(file.resolve() if file.exists() else file for file in calibration),
            crs=None if reference is None else reference.crs,
            origin_m=(0.0, 0.0, 0.0) if reference is None else reference.origin_m,
            ortho=None if ortho is None else ortho.resolve(),
            dem=None if dem is None else dem.resolve(),
        )

    @property
    def map_reference(self) -> MapReference | None:
        """Where the map frame lies, where that is known."""
        return None if self.crs is None else MapReference(self.crs, self.origin_m)

    def write(self, folder: RunFolder) -> None:
        """Write ``source.json``."""
        write_whole(folder.source_path, self.model_dump_json(indent=2).encode())

    @classmethod
    def read(cls, folder: RunFolder) -> Self | None:
        """Read ``source.json``; None where the run has none.

        Raises
        ------
        InputError
            The file is damaged.
        """
        if not folder.source_path.is_file():
            return None
        try:
            return cls.model_validate_json(folder.source_path.read_bytes())
        except (OSError, ValidationError) as error:
            raise InputError("cannot be read", source=folder.source_path) from error
