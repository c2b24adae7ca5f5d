"""Maps: energies against the formula of a force on the tip, every format against its writer, masks counted."""

import struct
import time
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
from fitting.instruments import images as images_module
from fitting.instruments import recording as recording_module
from fitting.instruments.images import read_images
from fitting.instruments.recording import refuse_other_modes
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


def test_a_phase_of_the_opposite_sign_is_told_by_the_free_tip_and_without_a_stiffness_energies_are_over_it():
    amplitude, lag, energy = image()
    straight = tapping_map((amplitude, lag), **LEVER)
    turned = tapping_map((amplitude, -lag), **{**LEVER, "free_phase_deg": (-FREE_LAG, 0.2)})
    np.testing.assert_allclose(turned.energy, straight.energy, rtol=1e-12)
    np.testing.assert_allclose(turned.virial, straight.virial, rtol=1e-9)
    # on resonance only the sign of the virial hangs on the sense
    for one, word in ((straight, "lags"), (turned, "leads")):
        assert any(f"the phase {word}, which is assumed" in note for note in one.notes)
    stated = tapping_map((amplitude, -lag), phase_sense="lead", **{**LEVER, "free_phase_deg": -FREE_LAG})
    np.testing.assert_allclose(stated.energy, energy, rtol=2e-4)
    assert not any("Sign" in note for note in stated.notes)
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
    (path,) = written(tmp_path, "npz")
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


def test_images_of_other_modes_are_refused_by_name(tmp_path: Path):
    for name, value, refused in (
        ("ImagingMode", "PFM Mode", True),
        ("ImagingMode", "Contact", True),
        ("ImagingMode", "SS-PFM something new", True),
        ("ImagingMode", "AC Mode", False),
        ("DualACMode", "1", True),
        ("DualACMode", "0", False),
        ("Op. mode", "Lateral Force", True),
        ("Op. mode", "Dynamic Force", False),
        ("AFM mode", "PeakForce Tapping", True),
        ("AFM mode", "Tapping", False),
        ("Control::Imaging mode", "non-contact", False),
        ("Feedback Mode", "ac-ultra-speed-direct-drive", False),
        ("Feedback mode", "Free", False),
    ):
        said = ""
        try:
            refuse_other_modes({name: value}, "image")
        except TableError as error:
            said = str(error)
        assert (f"the mode {value!r} ({name})" in said) == refused, name
    amplitude, lag, _ = image()
    note = "ImagingMode: PFM Mode\rFreeAirAmplitude: NaN\r"
    (tmp_path / "pfm.ibw").write_bytes(igor_image(amplitude, lag, note))
    result = run(tmp_path / "pfm.ibw", *CALL, "13.4")
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert "was recorded in the mode 'PFM Mode' (ImagingMode)" in result.stderr


def nanosurf_image(amplitude: np.ndarray, phase: np.ndarray) -> bytes:
    """Return a NanoSurf file of two images, amplitude in m and phase in degrees, as 32-bit integers of their range."""
    header, data = ["[DataSet]", "Version=2", "GroupCount=1", "Gr0-Name=Scan", "Gr0-ID=1", "Gr0-Count=2"], b""
    header += ["Gr0-Ch0=DataSet-0:0", "Gr0-Ch1=DataSet-0:1"]
    size = ["Version=2", "SaveMode=Binary", "SaveBits=32", "SaveSign=Signed", "SaveOrder=Intel"]
    size += ["Frame=Scan forward", "Dim0Name=X*", "Dim0Unit=m", "Dim1Name=Y*", "Dim1Unit=m", "Dim1Min=0"]
    size += ["Dim0Min=0", "Dim0Range=2e-6", "Dim1Range=1e-6"]
    for number, (name, unit, values) in enumerate((("Amplitude", "m", 1e-9 * amplitude), ("Phase", "°", phase))):
        low, width = float(values.min()), float(np.ptp(values))
        rows, columns = values.shape
        header += [f"[DataSet-0:{number}]", f"Points={columns}", f"Lines={rows}", *size]
        header += [f"Dim2Name={name}", f"Dim2Unit={unit}", f"Dim2Min={low!r}", f"Dim2Range={width!r}"]
        counts = np.round((values - low) / width * (2.0**32 - 1.0) - 2.0**31).astype("<i4")
        # the first line stands below
        data += counts[::-1].tobytes()
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


def igor_image(amplitude: np.ndarray, phase: np.ndarray, more: str = "ImagingMode: AC Mode\r") -> bytes:
    """Return an Igor wave of three images."""
    channels = {"HeightRetrace": amplitude, "AmplitudeRetrace": 1e-9 * amplitude, "PhaseRetrace": phase}
    note = f"FastScanSize: 2e-06\rSlowScanSize: 1e-06\r{more}"
    return igor_wave({name: values.T[:, ::-1] for name, values in channels.items()}, note)


def written(folder: Path, kind: str) -> list[Path]:
    amplitude, lag, _ = image()
    path, phase = folder / f"image.{kind}", folder / "phase.csv"
    if kind == "npz":
        np.savez(path, amplitude_nm=amplitude, phase_deg=lag)
    elif kind == "npy":
        np.save(path, np.stack([amplitude, lag]))
    elif kind == "csv":
        np.savetxt(path, amplitude, delimiter=",", header="amplitude in nm\n")
        np.savetxt(phase, lag, delimiter=",")
        return [path, phase]
    else:
        path.write_bytes({"ibw": igor_image, "gwy": gwyddion_image, "nid": nanosurf_image}[kind](amplitude, lag))
    return [path]


@pytest.mark.parametrize("kind", ["npz", "npy", "csv", "ibw", "gwy", "nid"])
def test_images_of_every_format_are_read(tmp_path: Path, kind: str):
    if kind in {"gwy", "nid"}:
        pytest.importorskip("gwyddionpy")
    amplitude, lag, _ = image()
    found = read_images(*written(tmp_path, kind))
    np.testing.assert_allclose(found.amplitude, amplitude, rtol=3e-7)
    np.testing.assert_allclose(found.phase_deg, lag, rtol=3e-7)
    assert found.size_m == ((1e-6, 2e-6) if kind in {"ibw", "gwy", "nid"} else None)
    if kind == "csv":
        amplitude_file, phase_file = written(tmp_path, kind)
        assert np.array_equal(read_images((amplitude_file, phase_file)).phase_deg, found.phase_deg)


@pytest.mark.filterwarnings("ignore")
def test_a_measured_image_by_gwyddion_is_what_the_vendors_package_reads():
    package = pytest.importorskip("NSFopen.read")
    pytest.importorskip("gwyddionpy")
    examples = Path(pytest.importorskip("NSFopen").__file__).parent / "example"
    image, friction = examples / "Plotting_Data" / "MoS2.nid", examples / "Lateral_Force" / "SBS-PMMA.nid"
    if not (image.exists() and friction.exists()):
        pytest.skip("this release of NSFopen comes without its examples")
    theirs = package.read(str(image)).data["Image"]["Forward"]
    found = read_images(image)
    # Gwyddion counts rows from above
    for ours, name in ((found.amplitude, "Amplitude"), (found.phase_deg, "Phase")):
        wanted = np.asarray(theirs[name])
        assert any(np.allclose(ours, rows, rtol=1e-6, atol=1e-9) for rows in (wanted, wanted[::-1]))
    assert found.in_volts
    assert found.known["drive_frequency_khz"].value == 172.823
    with pytest.raises(TableError, match=r"the mode 'Lateral Force' \(Op\. mode\)"):
        read_images(friction)


def test_gwyddions_program_is_limited_and_named_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("gwyddionpy")
    (path,) = written(tmp_path, "nid")
    strange = tmp_path / "-strange.xyz"
    strange.write_bytes(b"\xff\xfe nothing that anybody knows")
    for name, value, file, said in (
        ("_PATIENCE_S", 60.0, strange, "gwyddionpy does not read it (cannot load"),
        ("_PATIENCE_S", 1e-3, path, "did not finish within 0.001 s"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(images_module, name, value)
            with pytest.raises(TableError) as raised:
                read_images(file)
        assert said in str(raised.value)
        assert "\n" not in str(raised.value)

    def missing(name: str):
        raise ModuleNotFoundError(name=name)

    monkeypatch.setattr(recording_module, "import_module", missing)
    with pytest.raises(TableError, match=r"package gwyddionpy; install it with: pip install 'afm-jax\[gwyddion\]'"):
        read_images(path)


def test_the_command_writes_picture_and_arrays_and_says_the_common_error_once(tmp_path: Path):
    zarr = pytest.importorskip("zarr")
    (path,) = written(tmp_path, "gwy")
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
    np.savez(tmp_path / "one.npz", amplitude=amplitude)
    np.savez(tmp_path / "sizes.npz", amplitude=amplitude, phase=lag[:-1])
    np.savez(tmp_path / "volts.npz", amplitude_v=amplitude, phase_deg=lag)
    (tmp_path / "ragged.csv").write_text("1,2\n3\n")
    (tmp_path / "cut.gwy").write_bytes(b"GWYPGwyContainer\0" + struct.pack("<I", 1000) + b"/0/data\0o")
    (stored,), _ = written(tmp_path, "npz"), written(tmp_path, "gwy")
    for name, said in (
        ("one.npz", "no phase_lag_deg among the channels amplitude; say --columns"),
        ("sizes.npz", "must be rows of one size"),
        ("volts.npz", "give --nm-per-volt NM"),
        ("ragged.csv", "cannot be read (ValueError: the number of columns changed"),
        ("cut.gwy", "gwyddionpy does not read it"),
    ):
        result = run(tmp_path / name, *CALL, "13.4")
        assert (result.exit_code, result.stdout, len(result.stderr.splitlines())) == (2, "", 1), name
        assert said in result.stderr
    for call, said in (
        (
            ["tapping-map", stored],
            "give --free-frequency-khz KHZ --quality-factor Q --free-amplitude-nm NM --free-phase-deg DEGREES",
        ),
        (["read", tmp_path / "image.gwy"], "energies of images: afm-jax tapping-map"),
        (["tapping", stored], "energies of images: afm-jax tapping-map"),
    ):
        result = CliRunner().invoke(main, [str(word) for word in call])
        assert result.exit_code == 2
        assert said in result.stderr
    with pytest.raises(
        TableError, match="the amplitude has 12 x 20 pixels, the phase 20; they must be rows of one size"
    ):
        tapping_map((amplitude, lag[0]), **LEVER)


@pytest.mark.slow
def test_a_million_pixels_take_less_than_two_seconds():
    amplitude, lag, _ = image(1024, 1024)
    begun = time.process_time()
    found = tapping_map((amplitude, lag), **LEVER)
    assert time.process_time() - begun < 2.0
    assert found.counts["used"] == 1024**2
