"""Maps: energies against the formula of a force on the tip, every format against its writer, masks counted."""

import struct
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from fitting import TableError, tapping_map
from fitting.examples.make_raw_curve import (
    DRIVE_KHZ,
    FREE_FREQUENCY_KHZ,
    FREE_NM,
    QUALITY_FACTOR,
    SPRING_CONSTANT,
    raw_curve,
    true_energy_aj,
    true_lag_deg,
)
from fitting.instruments.gwyddion import images_as_bytes
from fitting.instruments.images import read_images
from fitting.tapping_curves.curve import Instrument
from fitting.tapping_curves.energy import energies
from tests.html_pages import read_page
from tests.instrument_files import igor_wave
from tests.strict_reading import strictly
from tests.test_tapping import curve_of_rows

FREE_LAG = float(true_lag_deg(np.ones(1))[0])
LEVER: dict[str, Any] = {
    "spring_constant_n_per_m": (SPRING_CONSTANT, 4.0),
    "quality_factor": (QUALITY_FACTOR, 5.0),
    "free_frequency_khz": (FREE_FREQUENCY_KHZ, 0.01),
    "drive_frequency_khz": DRIVE_KHZ,
    "free_amplitude_nm": (FREE_NM, 0.03),
    "free_phase_deg": (FREE_LAG, 0.2),
    "drive": "force",
}
GRID_CALL = ["--spring-constant", "44", "--quality-factor", "230 +- 5", "--free-frequency-khz", "344.604 +- 0.01"]
GRID_CALL += ["--drive-frequency-khz", "344.6", "--drive", "force"]
CALL = [*GRID_CALL, "--free-phase-deg", str(FREE_LAG), "--free-amplitude-nm"]


def image(rows: int = 12, columns: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return amplitude in nm, lag and true energy of an image whose amplitude rises from 0.78 to 0.98 of the free."""
    ratio = np.linspace(0.78, 0.98, rows * columns).reshape(rows, columns)
    return FREE_NM * ratio, true_lag_deg(ratio), true_energy_aj(ratio)


def run(*arguments: object):
    return CliRunner().invoke(main, ["tapping-map", *map(str, arguments)])


def test_every_pixel_has_the_energy_of_the_formula_and_its_own_error():
    amplitude, lag, energy = image()
    found = tapping_map((amplitude, lag), amplitude_error_nm=0.03, phase_error_deg=0.12, **LEVER)
    # what the air takes at harmonics is left out of the formula
    np.testing.assert_allclose(found.energy, energy, rtol=2e-4)
    random, shape = np.random.default_rng(3), (400, *amplitude.shape)
    noisy = amplitude + 0.03 * random.standard_normal(shape)
    lags = np.deg2rad(lag + 0.12 * random.standard_normal(shape))
    s = DRIVE_KHZ / FREE_FREQUENCY_KHZ
    size, k = np.abs(1.0 - s**2 + 1j * s / QUALITY_FACTOR), SPRING_CONSTANT * noisy
    drawn = np.pi * k * (FREE_NM * size * np.sin(lags) - s * noisy / QUALITY_FACTOR)
    np.testing.assert_allclose(found.energy_error, drawn.std(axis=0), rtol=0.15)
    drawn = -0.5 * k * (FREE_NM * size * np.cos(lags) - noisy * (1.0 - s**2))
    np.testing.assert_allclose(found.virial, drawn.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(found.virial_error, drawn.std(axis=0), rtol=0.15)
    # the spring constant's part of the common error is its share of the median energy
    assert found.common["spring_constant"] == pytest.approx(4.0 / 44.0 * np.median(energy), rel=0.02)
    assert found.energy_common_error == pytest.approx(np.linalg.norm(list(found.common.values())))


@pytest.mark.parametrize(("drive", "ratio"), [("force", 1.0), ("base", 1.03)])
def test_maps_are_the_energies_of_curves_row_by_row(drive: Literal["force", "base"], ratio: float):
    random = np.random.default_rng(5)
    amplitude, behind = random.uniform(5.0, 40.0, 42), random.uniform(-30.0, 10.0, 42)
    known: dict[str, Any] = {"free_frequency_khz": 90.0, "quality_factor": 200.0, "spring_constant_n_per_m": 5.4}
    known |= {"free_amplitude_nm": 40.0, "drive_frequency_khz": 90.0 * ratio, "free_phase_deg": 33.0}
    found = tapping_map((amplitude.reshape(6, 7), 33.0 + behind.reshape(6, 7)), drive=drive, **known)
    gamma = 1.0 - ratio**2 + 1j * ratio / 200.0
    lag = np.rad2deg(np.angle(gamma) - (np.angle(1.0 - gamma) if drive == "base" else 0.0)) + behind
    rows = {"amplitude_nm": amplitude, "lag_deg": lag, "drive_frequency_khz": 90.0 * ratio}
    wanted = energies(curve_of_rows(42, drive=drive, **rows), Instrument(90.0, 200.0))
    used = (found.state == 0).ravel()
    assert used.any()
    np.testing.assert_allclose(found.energy.ravel()[used], wanted.energy_aj[used], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.virial.ravel()[used], wanted.virial_aj[used], rtol=1e-9, atol=1e-9)


def test_pixels_out_of_range_are_masked_and_counted():
    amplitude, lag, energy = image()
    amplitude[0, :4], lag[1, :3], amplitude[2, :2] = 1.1 * FREE_NM, -30.0, np.nan
    found = tapping_map((amplitude, lag), amplitude_error_nm=0.03, phase_error_deg=0.12, **LEVER)
    counts = {"used": 231, "amplitude above free": 4, "energy below zero": 3, "not measured": 2}
    assert found.to_dict()["pixels"] == {"rows": 12, "columns": 20, **counts}
    masked = found.state != 0
    assert np.all(np.isnan(found.energy[masked]))
    np.testing.assert_allclose(found.energy[~masked], energy[~masked], rtol=2e-4)
    assert found.valid
    wrong = tapping_map((amplitude, lag), **{**LEVER, "free_amplitude_nm": 9.0})
    assert not wrong.valid
    assert "free amplitude, its phase, quality factor or units do not belong" in wrong.reasons[0]


def test_a_phase_of_the_opposite_sign_is_told_by_the_free_tip_and_without_a_stiffness_energies_are_over_it():
    amplitude, lag, energy = image()
    straight = tapping_map((amplitude, lag), **LEVER)
    turned = tapping_map((amplitude, -lag), **{**LEVER, "free_phase_deg": (-FREE_LAG, 0.2)})
    np.testing.assert_allclose(turned.energy, straight.energy, rtol=1e-12)
    np.testing.assert_allclose(turned.virial, straight.virial, rtol=1e-9)
    unknown = ("free_phase_deg", "spring_constant_n_per_m")
    found = tapping_map((amplitude, -lag), **{key: value for key, value in LEVER.items() if key not in unknown})
    assert found.unit == "nm^2"
    np.testing.assert_allclose(found.energy, energy / SPRING_CONSTANT, rtol=2e-4)
    assert "spring_constant" not in found.common
    for one, said in (
        (turned, "Sign: the free tip reads"),
        (found, "Phase: the free tip is taken to read"),
        (found, "over it, in nm^2"),
    ):
        assert any(said in note for note in one.notes)


def nanosurf_image(amplitude: np.ndarray, phase: np.ndarray) -> bytes:
    """Return a NanoSurf file of two images, amplitude in m and phase in degrees, as 32-bit integers of their range."""
    header, data = ["[DataSet]", "Version=2"], b""
    size = ["SaveBits=32", "Frame=Scan forward", "Dim0Name=X*", "Dim0Unit=m"]
    size += ["Dim0Min=0", "Dim0Range=2e-6", "Dim1Range=1e-6"]
    for number, (name, unit, values) in enumerate((("Amplitude", "m", 1e-9 * amplitude), ("Phase", "°", phase))):
        low, width = float(values.min()), float(np.ptp(values))
        rows, columns = values.shape
        header += [f"[DataSet-0:{number}]", f"Points={columns}", f"Lines={rows}", *size]
        header += [f"Dim2Name={name}", f"Dim2Unit={unit}", f"Dim2Min={low!r}", f"Dim2Range={width!r}"]
        counts = np.round((values - low) / width * (2.0**32 - 1.0) - 2.0**31).astype("<i4")
        data += counts.tobytes()
    return "\r\n".join(header).encode("latin-1") + b"\r\n\r\n#!" + data


def gwyddion_image(amplitude: np.ndarray, phase: np.ndarray) -> bytes:
    """Return a Gwyddion file of two images as the package gwyfile writes them."""
    gwyfile = pytest.importorskip("gwyfile.objects")
    content = gwyfile.GwyContainer()
    for number, (title, unit, values) in enumerate((("Amplitude", "m", 1e-9 * amplitude), ("Phase", "deg", phase))):
        content[f"/{number}/data/title"] = title
        sides = {"xreal": 2e-6, "yreal": 1e-6, "si_unit_xy": "m", "si_unit_z": unit}
        content[f"/{number}/data"] = gwyfile.GwyDataField(values, **sides)
    return b"GWYP" + content.serialize()


def igor_image(amplitude: np.ndarray, phase: np.ndarray) -> bytes:
    """Return an Igor wave of three images."""
    channels = {"HeightRetrace": amplitude, "AmplitudeRetrace": 1e-9 * amplitude, "PhaseRetrace": phase}
    note = "FastScanSize: 2e-06\rSlowScanSize: 1e-06\r"
    return igor_wave({name: values.T[:, ::-1] for name, values in channels.items()}, note)


def written(folder: Path, kind: str) -> list[Path]:
    amplitude, lag, _ = image()
    path, phase = folder / f"image.{kind}", folder / "phase.csv"
    if kind == "npz":
        np.savez(path, amplitude_nm=amplitude, phase_deg=lag)
    elif kind == "npy":
        np.save(path, np.stack([amplitude, lag]))
    elif kind == "csv":
        np.savetxt(path, amplitude, delimiter=",")
        np.savetxt(phase, lag, delimiter=",")
        return [path, phase]
    else:
        path.write_bytes({"ibw": igor_image, "gwy": gwyddion_image, "nid": nanosurf_image}[kind](amplitude, lag))
    return [path]


@pytest.mark.parametrize("kind", ["npz", "npy", "csv", "ibw", "gwy", "nid"])
def test_images_of_every_format_are_read(tmp_path: Path, kind: str):
    amplitude, lag, _ = image()
    found = read_images(*written(tmp_path, kind))
    np.testing.assert_allclose(found.amplitude, amplitude, rtol=3e-7)
    np.testing.assert_allclose(found.phase_deg, lag, rtol=3e-7)
    assert found.size_m == ((1e-6, 2e-6) if kind in {"ibw", "gwy", "nid"} else None)


def test_the_command_writes_picture_and_arrays_and_says_the_common_error_once(tmp_path: Path):
    zarr, gwyfile = pytest.importorskip("zarr"), pytest.importorskip("gwyfile")
    (path,) = written(tmp_path, "gwy")
    out = tmp_path / "report"
    formats = ["--format", "npz", "--format", "gwy", "--format", "zarr"]
    result = run(path, *CALL, "13.4", *formats, "--json", "--out", out)
    assert result.exit_code == 0, result.stderr
    _, _, energy = image()
    answer = strictly(result.stdout)
    assert answer["pixels"]["used"] == 240
    assert answer["energy"]["median"] == pytest.approx(np.median(energy), rel=1e-3)
    assert (out / "map.txt").read_text("utf-8").count("common error of the energy") == 1
    endings = ("html", "png", "json", "txt", "npz", "gwy", "zarr")
    assert {one.name for one in out.iterdir()} == {f"map.{ending}" for ending in endings}
    assert len(list(read_page((out / "map.html").read_text("utf-8")).iter("img"))) == 1
    theirs = gwyfile.load(str(out / "map.gwy"))
    assert theirs["/0/data/title"] == "Energy of a tap"
    assert theirs["/0/data"].xreal == pytest.approx(2e-6)
    stored = zarr.open_group(str(out / "map.zarr"), mode="r")["energy"]
    for found in (np.load(out / "map.npz")["energy"], np.asarray(stored), 1e18 * theirs["/0/data"].data):
        np.testing.assert_allclose(found, energy, rtol=2e-4)
    assert run(path, *CALL, "9").exit_code == 3


def test_masked_pixels_are_masked_in_gwyddion_too():
    theirs = pytest.importorskip("gwyfile.objects")
    data = images_as_bytes({"e": (np.array([[1.0, np.nan], [2.0, 3.0]]), "J")}, (1.0, 1.0), "")
    content: Any = theirs.GwyObject.frombuffer(data[4:])
    np.testing.assert_array_equal(content["/0/mask"].data, [[0.0, 1.0], [0.0, 0.0]])
    np.testing.assert_array_equal(content["/0/data"].data, [[1.0, 1.0], [2.0, 3.0]])


def test_a_grid_of_curves_is_read_at_one_amplitude(tmp_path: Path):
    curves = [raw_curve(300, seed=seed, drift=0.0) for seed in range(6)]
    names = ("amplitude_v", "phase_deg", "height_nm")
    arrays: dict[str, Any] = {
        name: np.reshape([getattr(one, name)[0] for one in curves], (2, 3, 300)) for name in names
    }
    np.savez(tmp_path / "grid.npz", **arrays)
    lever = [*GRID_CALL, "--nm-per-volt", "42", "--at", "0.85", "--json"]
    result = run(tmp_path / "grid.npz", *lever)
    assert result.exit_code == 0, result.stderr
    answer = strictly(result.stdout)
    masked = ("amplitude above free", "energy below zero", "not measured")
    assert answer["pixels"] == {"rows": 2, "columns": 3, "used": 6} | dict.fromkeys(masked, 0)
    assert answer["energy"]["median"] == pytest.approx(float(true_energy_aj(np.full(1, 0.85))[0]), rel=0.03)
    # the same curves side by side in a file without a head
    blocks = [[*c.height_nm, *c.deflection_v, *c.amplitude_v, *c.phase_deg] for c in curves]
    np.savetxt(tmp_path / "grid.txt", np.concatenate(blocks).T, delimiter="\t")
    columns = "offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8:deg"
    call = [tmp_path / "grid.txt", *lever, "--columns", columns, "--grid"]
    again = strictly(run(*call, "2x3").stdout)
    assert again["energy"]["median"] == pytest.approx(answer["energy"]["median"], rel=0.01)
    refused = run(*call, "2x2")
    assert (refused.exit_code, len(refused.stderr.splitlines())) == (2, 1)
    assert "holds 6 curves, not 2 x 2 = 4" in refused.stderr


def test_wrong_images_and_those_for_another_command_are_one_line(tmp_path: Path):
    amplitude, lag, _ = image()
    np.savez(tmp_path / "one.npz", amplitude=amplitude)
    np.savez(tmp_path / "sizes.npz", amplitude=amplitude, phase=lag[:-1])
    np.savez(tmp_path / "volts.npz", amplitude_v=amplitude, phase_deg=lag)
    (tmp_path / "ragged.csv").write_text("1,2\n3\n")
    (tmp_path / "cut.gwy").write_bytes(b"GWYPGwyContainer\0" + struct.pack("<I", 1000) + b"/0/data\0o")
    (stored,), _ = written(tmp_path, "npz"), written(tmp_path, "gwy")
    for name, said in (
        ("one.npz", "none of the images amplitude is called"),
        ("sizes.npz", "must be of one size"),
        ("volts.npz", "give --nm-per-volt NM"),
        ("ragged.csv", "an image is rows of numbers"),
        ("cut.gwy", "damaged or cut off"),
    ):
        result = run(tmp_path / name, *CALL, "13.4")
        assert (result.exit_code, result.stdout, len(result.stderr.splitlines())) == (2, "", 1), name
        assert said in result.stderr
    for call, said in (
        (["tapping-map", stored], "give --free-frequency-khz KHZ --quality-factor Q --free-amplitude-nm NM"),
        (["read", tmp_path / "image.gwy"], "holds images; their energies: afm-jax tapping-map"),
        (["tapping", stored], "energies of images: afm-jax tapping-map"),
    ):
        result = CliRunner().invoke(main, [str(word) for word in call])
        assert result.exit_code == 2
        assert said in result.stderr
    with pytest.raises(TableError, match="must be two arrays"):
        tapping_map((amplitude, lag[0]), **LEVER)
    with pytest.raises(ValueError, match="`ratio` must be at least 0\\.05 and below 1"):
        read_images(stored, ratio=0.049)


@pytest.mark.slow
def test_a_million_pixels_take_less_than_two_seconds():
    amplitude, lag, _ = image(1024, 1024)
    begun = time.process_time()
    found = tapping_map((amplitude, lag), **LEVER)
    assert time.process_time() - begun < 2.0
    assert found.counts["used"] == 1024**2
