"""Maps: energies against the formula of a force on the tip, every format against its writer, masks counted."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from afm_jax.saved import as_json
from fitting import TableError, tapping_map
from fitting.examples.make_raw_curve import (
    DRIVE_KHZ,
    FREE_FREQUENCY_KHZ,
    FREE_NM,
    QUALITY_FACTOR,
    SPRING_CONSTANT,
    true_energy_aj,
    true_lag_deg,
)
from fitting.instruments.images import read_images
from fitting.tapping_curves.curve import Instrument
from fitting.tapping_curves.energy import energies
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
    assert found.common["spring_constant_n_per_m"] == pytest.approx(4.0 / 44.0 * np.median(energy), rel=0.02)
    assert found.energy_common_error == pytest.approx(np.linalg.norm(list(found.common.values())))


@pytest.mark.parametrize(("drive", "ratio"), [("force", 1.0), ("base", 1.03)])
def test_maps_are_the_energies_of_curves_row_by_row(drive: Literal["force", "base"], ratio: float):
    random = np.random.default_rng(5)
    amplitude, behind = random.uniform(5.0, 40.0, 42), random.uniform(-30.0, 10.0, 42)
    known: dict[str, Any] = {"free_frequency_khz": 90.0, "quality_factor": 200.0, "spring_constant_n_per_m": 5.4}
    known |= {"free_amplitude_nm": 40.0, "drive_frequency_khz": 90.0 * ratio, "free_phase_deg": 33.0}
    images = amplitude.reshape(6, 7), 33.0 + behind.reshape(6, 7)
    found = tapping_map(images, phase_sense="lag", drive=drive, **known)
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
    assert as_json(found)["pixels"] == {"rows": 12, "columns": 20, **counts}
    masked = found.state != 0
    assert np.all(np.isnan(found.energy[masked]))
    np.testing.assert_allclose(found.energy[~masked], energy[~masked], rtol=2e-4)
    assert found.valid
    wrong = tapping_map((amplitude, lag), **{**LEVER, "free_amplitude_nm": 9.0})
    assert not wrong.valid
    doubt = "free amplitude, its phase, quality factor or units do not belong"
    assert any(doubt in reason for reason in wrong.reasons)


def test_without_a_stiffness_energies_are_over_it():
    amplitude, lag, energy = image()
    found = tapping_map((amplitude, lag), **{k: v for k, v in LEVER.items() if k != "spring_constant_n_per_m"})
    assert found.unit == "nm^2"
    np.testing.assert_allclose(found.energy, energy / SPRING_CONSTANT, rtol=2e-4)
    assert "spring_constant_n_per_m" not in found.common
    assert "over it, in nm^2" in found.known["spring_constant_n_per_m"].origin


def energy_of(drive: str, amplitude: float, behind: float, ratio: float, quality: float) -> float:
    """Return E in aJ of k = 44 N/m at a free amplitude of 13.4 nm: what the drive gives less what the air takes.

    With all harmonics of one brief impact a period, a tenth less; `behind`, of the free tip, is in degrees.
    """
    n = np.arange(1, 41)
    gamma = 1.0 - (n * ratio) ** 2 + 1j * n * ratio / quality
    free, turned = FREE_NM, np.exp(-1j * np.deg2rad(behind))
    z = -amplitude * turned
    if drive == "base":
        free = FREE_NM / abs(1.0 - gamma[0])
        z = z * np.exp(1j * np.angle(1.0 - gamma[0])) - gamma[0] * free
    # force of the drive k gamma (-A0) works pi Im(F conj Z) a period, friction k s/Q takes pi k s n^2 |Z_n|^2/Q
    force = gamma[0] * (z + free)
    given, others = np.pi * np.imag(gamma[0] * free * np.conj(z)), 0.9 * np.abs(n[1:] * force / gamma[1:]) ** 2
    taken = np.pi * ratio / quality * (abs(z) ** 2 + others.sum())
    return float(SPRING_CONSTANT * (-given - taken))


@pytest.mark.parametrize("drive", ["force", "base"])
@pytest.mark.parametrize(("quality", "ratio"), [(150.0, 0.99), (400.0, 1.0), (150.0, 1.03), (400.0, 1.05)])
def test_no_sense_of_the_phase_makes_a_wrong_energy_valid(drive: str, quality: float, ratio: float):
    gamma = 1.0 - ratio**2 + 1j * ratio / quality
    free_lag = float(np.rad2deg(np.angle(gamma) - (np.angle(1.0 - gamma) if drive == "base" else 0.0)))
    lever: dict[str, Any] = LEVER | {
        "quality_factor": (quality, 0.5),
        "free_frequency_khz": (300.0, 0.003),
        "drive": drive,
    }
    lever |= {"drive_frequency_khz": 300.0 * ratio, "amplitude_error_nm": 0.03, "phase_error_deg": 0.1}
    seen = []
    for behind in (-25.0, -8.0, -2.0, 2.0, 8.0, 25.0):
        energy = energy_of(drive, 0.9 * FREE_NM, behind, ratio, quality)
        if energy <= 0.0:
            continue
        for free, sign in ((free_lag, 1.0), (-free_lag, -1.0), (0.0, 1.0), (0.0, -1.0)):
            arrays = np.full((5, 5), 0.9 * FREE_NM), np.full((5, 5), free + sign * behind)
            known: dict[str, Any] = lever | {"free_phase_deg": (free, 0.02)}
            right = tapping_map(arrays, phase_sense="lag" if sign > 0.0 else "lead", **known)
            assert np.median(right.energy) == pytest.approx(energy, rel=1e-9)
            found = tapping_map(arrays, **known)
            same = np.sign(np.median(found.virial)) == np.sign(np.median(right.virial))
            assumed = any("which is assumed" in note for note in found.notes)
            if found.valid:
                assert abs(np.median(found.energy) - energy) < 3.0 * found.energy_common_error
                assert same or (assumed and ratio == 1.0)
            elif right.valid:
                assert 'say `phase_sense="lag|lead"`' in found.reasons[0]
            seen.append(found.valid)
    assert any(seen) or (ratio == 1.05 and not seen)


def test_without_the_free_tip_an_image_gives_no_energy(tmp_path: Path):
    path = written(tmp_path, "npz")
    for left_out in ("free_phase_deg", "free_amplitude_nm"):
        known = {key: value for key, value in LEVER.items() if key != left_out}
        with pytest.raises(TableError, match=f"give `{left_out}=.*; record amplitude and phase of the free tip"):
            tapping_map(path, **known)
    result = run(path, *GRID_CALL, "--free-amplitude-nm", "13.4")
    assert (result.exit_code, result.stdout, len(result.stderr.splitlines())) == (2, "", 1)
    assert "give --free-phase-deg DEGREES; record" in result.stderr


def test_an_energy_below_zero_or_within_its_errors_is_not_valid():
    # 13 nm behind by 30 degrees: the drive gives less than the air takes, however the phase counts
    low = tapping_map((np.full((5, 5), 13.0), np.full((5, 5), 60.0)), **LEVER)
    energy = energy_of("force", 13.0, 60.0 - FREE_LAG, DRIVE_KHZ / FREE_FREQUENCY_KHZ, QUALITY_FACTOR)
    assert energy < 0.0
    assert not low.valid
    assert any(f"below zero beyond its errors ({energy:.3g} +- " in reason for reason in low.reasons)
    amplitude, lag, energies_aj = image()
    middle = np.median(energies_aj)
    # the free amplitude's share: E = pi k A (A0 sin(lag) - A)/Q
    slope = np.pi * SPRING_CONSTANT / QUALITY_FACTOR * np.median(amplitude)
    for share, valid in ((0.2, True), (0.3, False)):
        known: dict[str, Any] = LEVER | {"free_amplitude_nm": (FREE_NM, share * middle / slope)}
        found = tapping_map((amplitude, lag), **known)
        assert found.energy_common_error / middle == pytest.approx(share, rel=0.25)
        assert found.valid == valid
    assert "only bracketed" in found.reasons[0]
    assert "most of its error comes from free amplitude" in found.reasons[0]
    noisy = tapping_map((amplitude, lag), amplitude_error_nm=0.5, phase_error_deg=0.1, **LEVER)
    assert "most of its error comes from noise of a pixel" in noisy.reasons[0]


@pytest.mark.parametrize(
    ("name", "value", "refused"),
    [
        ("ImagingMode", "SS-PFM something new", True),
        ("ImagingMode", "AC Mode", False),
        ("DualACMode", "1", True),
        ("DualACMode", "0", False),
        ("AFM mode", "PeakForce Tapping", True),
        ("Control::Imaging mode", "non-contact", False),
    ],
)
def test_images_of_other_modes_are_refused_by_name(tmp_path: Path, name: str, value: str, *, refused: bool):
    amplitude, lag, _ = image()
    (tmp_path / "image.ibw").write_bytes(igor_image(amplitude, lag, f"{name}: {value}\rFreeAirAmplitude: NaN\r"))
    result = run(tmp_path / "image.ibw", *CALL, "13.4")
    assert result.exit_code == (2 if refused else 0)
    assert (f"was recorded in the mode '{value}' ({name})" in result.stderr) is refused


def gwyddion_image(amplitude: np.ndarray, phase: np.ndarray) -> bytes:
    """Return a Gwyddion file of two images as the package gwyfile writes them."""
    gwyfile = pytest.importorskip("gwyfile.objects")
    content = gwyfile.GwyContainer()
    for number, (title, unit, values) in enumerate((("Amplitude", "m", 1e-9 * amplitude), ("Phase", "deg", phase))):
        content[f"/{number}/data/title"] = title
        sides = {"xreal": 2e-6, "yreal": 1e-6, "si_unit_xy": "m", "si_unit_z": unit}
        content[f"/{number}/data"] = gwyfile.GwyDataField(values, **sides)
    return b"GWYP" + content.serialize()


def igor_image(amplitude: np.ndarray, phase: np.ndarray, more: str = "ImagingMode: AC Mode\r") -> bytes:
    """Return an Igor wave of three images."""
    channels = {"HeightRetrace": amplitude, "AmplitudeRetrace": 1e-9 * amplitude, "PhaseRetrace": phase}
    note = f"FastScanSize: 2e-06\rSlowScanSize: 1e-06\r{more}"
    return igor_wave({name: values.T[:, ::-1] for name, values in channels.items()}, note)


def written(folder: Path, kind: str) -> Path:
    amplitude, lag, _ = image()
    path = folder / f"image.{kind}"
    if kind == "npz":
        np.savez(path, amplitude_nm=amplitude, phase_deg=lag)
    elif kind == "npy":
        np.save(path, np.stack([amplitude, lag]))
    else:
        path.write_bytes({"ibw": igor_image, "gwy": gwyddion_image}[kind](amplitude, lag))
    return path


@pytest.mark.parametrize("kind", ["npz", "npy", "ibw", "gwy"])
def test_images_of_every_format_are_read(tmp_path: Path, kind: str):
    if kind == "gwy":
        pytest.importorskip("gwyddionpy")
    amplitude, lag, _ = image()
    found = read_images(written(tmp_path, kind))
    np.testing.assert_allclose(found.amplitude, amplitude, rtol=3e-7)
    np.testing.assert_allclose(found.phase_deg, lag, rtol=3e-7)
    assert found.size_m == ((1e-6, 2e-6) if kind in {"ibw", "gwy"} else None)


def test_the_command_writes_picture_and_arrays_and_says_the_common_error_once(tmp_path: Path):
    zarr = pytest.importorskip("zarr")
    path = written(tmp_path, "gwy")
    out = tmp_path / "report"
    formats = ["--format", "npz", "--format", "gsf", "--format", "zarr"]
    result = run(path, *CALL, "13.4", *formats, "--json", "--out", out)
    assert result.exit_code == 0, result.stderr
    _, _, energy = image()
    answer = strictly(result.stdout)
    assert answer["pixels"]["used"] == 240
    assert answer["energy"]["median"] == pytest.approx(np.median(energy), rel=1e-3)
    assert (out / "map.txt").read_text("utf-8").count("common error of the energy") == 1
    names = {f"map.{ending}" for ending in ("png", "json", "txt", "npz", "zarr")}
    names |= {f"map_{name}.gsf" for name in ("energy", "energy_error", "virial", "virial_error")}
    assert {one.name for one in out.iterdir()} == names
    stored = zarr.open_group(str(out / "map.zarr"), mode="r")["energy"]
    for found in (np.load(out / "map.npz")["energy"], np.asarray(stored)):
        np.testing.assert_allclose(found, energy, rtol=2e-4)
    assert run(path, *CALL, "9").exit_code == 3


def test_gwyddion_opens_its_simple_fields(tmp_path: Path):
    package = pytest.importorskip("gwyddionpy")
    amplitude, lag, energy = image(7, 9)
    amplitude[2, 3] = np.nan
    (tmp_path / "image.gwy").write_bytes(gwyddion_image(amplitude, lag))
    assert run(tmp_path / "image.gwy", *CALL, "13.4", "--format", "gsf", "--out", tmp_path / "out").exit_code == 0
    (theirs,) = package.load(tmp_path / "out" / "map_energy.gsf").channels.values()
    assert (theirs.name, theirs.si_unit_z, theirs.si_unit_xy) == ("energy", "J", "m")
    assert (theirs.yreal, theirs.xreal) == pytest.approx((1e-6, 2e-6))
    kept = np.isfinite(amplitude)
    np.testing.assert_allclose(1e18 * theirs.data[kept], energy[kept], rtol=2e-4)


def test_images_of_one_number_or_of_none(tmp_path: Path):
    one, errors = (np.array([[12.0]]), np.array([[85.0]])), {"amplitude_error_nm": 0.03, "phase_error_deg": 0.1}
    with pytest.raises(TableError, match="no three pixels stand side by side to read the noise off"):
        tapping_map(one, **LEVER)
    found = tapping_map(one, **errors, **LEVER)
    energy = energy_of("force", 12.0, 85.0 - FREE_LAG, DRIVE_KHZ / FREE_FREQUENCY_KHZ, QUALITY_FACTOR)
    assert found.energy.item() == pytest.approx(energy, rel=1e-9)
    found.plot(tmp_path / "one.png")
    for empty in (np.full((4, 4), np.nan), np.full((4, 4), -1.0)):
        with pytest.raises(TableError, match="no pixel has both an amplitude above 0 and a phase"):
            tapping_map((empty, np.full((4, 4), 80.0)), **LEVER)


def test_wrong_images_and_those_for_another_command_are_one_line(tmp_path: Path):
    amplitude, lag, _ = image()
    stored = written(tmp_path, "npz")
    np.savez(tmp_path / "one.npz", amplitude=amplitude)
    np.savez(tmp_path / "sizes.npz", amplitude=amplitude, phase=lag[:-1])
    np.savez(tmp_path / "volts.npz", amplitude_v=amplitude, phase_deg=lag)
    for call, said in (
        (["tapping-map", tmp_path / "one.npz", *CALL, "13.4"], "no phase_lag_deg among the channels amplitude"),
        (["tapping-map", tmp_path / "sizes.npz", *CALL, "13.4"], "must be rows of one size"),
        (["tapping-map", tmp_path / "volts.npz", *CALL, "13.4"], "give --nm-per-volt NM"),
        (["tapping-map", stored], "give --free-frequency-khz KHZ --quality-factor Q --free-amplitude-nm NM"),
        (["tapping", stored], "energies of images: afm-jax tapping-map"),
    ):
        result = CliRunner().invoke(main, [str(word) for word in call])
        assert (result.exit_code, result.stdout, len(result.stderr.splitlines())) == (2, "", 1), call
        assert said in result.stderr
