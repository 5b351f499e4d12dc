"""Boundaries in real B-scans; spacing does not matter to them and is set to one unit a pixel."""

import csv
from pathlib import Path

import numpy as np
import pytest
import tifffile
from skimage.io import imread

from optical_palpation.thickness.boundaries import find_layer, find_surface

PIXEL = (1.0, 1.0, 1.0)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def bscan(path: Path) -> np.ndarray:
    return tifffile.imread(path).astype(np.float32)[:, None, :]


def test_skin_surfaces_pass_their_acceptance(shared_data):
    means = {}
    for path in sorted((shared_data / "surfaces").glob("*.tif")):
        mask = imread(path.with_name(f"{path.stem}_mask.png")) > 0
        drawn = mask.any(axis=0)
        # The mask ends with the last row above the tissue: the border is half a pixel below it.
        truth = len(mask) - 0.5 - np.argmax(mask[::-1], axis=0)
        surface = find_surface(bscan(path), spacing=PIXEL, scale="dB")
        error = np.abs(surface.depth.values[0] - truth)[drawn]
        means[path.stem] = error.mean()
        assert surface.filled.values[0].mean() < 0.10, path.stem
        assert error.mean() < 10, path.stem
        assert np.percentile(error, 90) < 40, path.stem
    assert len(means) == 7
    assert np.median(list(means.values())) <= 3.0, means


def test_gap_between_coverslip_and_skin(shared_data):
    folder = shared_data / "surfaces"
    truth = rows_of(folder / "gap_columns.csv")
    columns = [int(row["column_px"]) for row in truth]
    gap = np.array([float(row["gap_px"]) for row in truth])
    layer = find_layer(bscan(folder / f"{truth[0]['image']}.tif"), spacing=PIXEL, scale="dB")
    error = layer.thickness.values[0][columns] - gap
    assert np.mean(np.abs(error)) <= 4.0
    assert abs(np.mean(error)) < 2.0


@pytest.mark.parametrize(("band", "between"), [("band1", (180, 380)), ("band2", (380, 580))])
def test_layers_of_a_printed_phantom(shared_data, band, between):
    folder = shared_data / "bscans"
    truth = rows_of(folder / "phantom_0001_edges.csv")
    columns = [int(row["column_px"]) for row in truth]
    layer = find_layer(
        bscan(folder / "phantom_0001_noisy.tif"),
        spacing=PIXEL,
        scale="linear",
        window="fall",
        window_range=between,
        sample_range=between,
    )
    for name, side in (("window_depth", "top"), ("sample_depth", "bottom")):
        drawn = np.array([float(row[f"{band}_{side}_row_px"]) for row in truth])
        assert np.mean(np.abs(layer[name].values[0][columns] - drawn)) <= 2.0
