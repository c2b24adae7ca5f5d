"""Instruments' files made for tests: a tapping curve that every format holds, and Igor waves byte by byte."""

import struct

import numpy as np
import pytest

FREE_NM, LAG_DEG, TOUCHES_NM = 40.0, 90.0, -40.0


def tapping_rows(points: int = 120, *, retract: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heights (growing towards the tip), amplitudes and lags of a hard sample that the tip meets at -40 nm."""
    offset = np.linspace(-80.0, -10.0, points)
    if retract:
        offset = offset[::-1]
    noise = 0.02 * np.sin(7.3 * np.arange(points))
    amplitude = np.minimum(FREE_NM, -offset) + noise
    return offset, amplitude, LAG_DEG - 0.8 * np.maximum(offset - TOUCHES_NM, 0.0) + 0.1 * noise


def separated(columns: dict[str, np.ndarray], sign: str = ",", decimal: str = ".") -> str:
    """Return columns as text with a head, six decimals a number."""
    rows = [
        sign.join(f"{cell:.6f}".replace(".", decimal) for cell in row) for row in zip(*columns.values(), strict=True)
    ]
    return "\n".join([sign.join(columns), *rows]) + "\n"


def igor_wave(columns: dict[str, np.ndarray], note: str, *, order: str = "<") -> bytes:
    """Return a binary wave of version 5 (WaveMetrics' Technical Note 003): a column or an image a channel, labelled."""
    pytest.importorskip("igor2")
    table = np.stack(list(columns.values()), axis=-1)
    data = np.asfortranarray(table).astype(order + "f4").tobytes(order="F")
    labels = b"".join(name.encode().ljust(32, b"\0") for name in ("", *columns))
    text = note.encode("latin-1")
    of_labels = [len(labels) if side == table.ndim - 1 else 0 for side in range(4)]
    sizes = [320 + len(data), 0, len(text), 0, 0, 0, 0, 0, *of_labels, 0, 0, 0]
    wave = struct.pack(order + "IIIihh6sh32sii", 0, 0, 0, table.size, 2, 0, b"", 1, b"ramp", 0, 0)
    shape = [*table.shape, 0, 0][:4]
    wave += struct.pack(order + "4i4d4d4s16s", *shape, *[1.0] * 4, *[0.0] * 4, b"", b"")
    wave = wave.ljust(320, b"\0")
    head = struct.pack(order + "h", 5)
    body = struct.pack(order + "15i", *sizes)
    checked = np.frombuffer(head + b"\0\0" + body + wave, order + "i2").astype(np.int64).sum()
    return head + struct.pack(order + "h", ((-checked + 32768) % 65536) - 32768) + body + wave + data + text + labels


def asylum_ramp(*, order: str = "<") -> bytes:
    """Return an Asylum ramp of `tapping_rows`, approach and retract, in SI units."""
    there, back = tapping_rows(), tapping_rows(retract=True)
    offset, amplitude, lag = (np.concatenate(pair) for pair in zip(there, back, strict=True))
    columns = {"ZSnsr": 1e-9 * offset, "Amp": 1e-9 * amplitude, "Phase": lag, "Defl": 1e-9 * 0.01 * offset}
    note = "SpringConstant: 5.4\rInvOLS: 1.1e-07\rAmpInvOLS: 1.2e-07\rDriveFrequency: 90000\rThermalFrequency: 90000\r"
    note += "ThermalQ: 200\r"
    return igor_wave(columns, note, order=order)


BRUKER = (
    "offset_nm=Calc_Ramp_Ex_nm/Calc_Ramp_Rt_nm:nm,lockin_amplitude_nm=Amplitude_Ex_mV/Amplitude_Rt_mV:mV,"
    "phase_lag_deg=Phase_Ex_Deg/Phase_Rt_Deg:deg"
)
"""The columns of `bruker_ramp`, as `notebooks/pages/tapping.md` names them."""


def bruker_ramp() -> str:
    """Return `tapping_rows` as NanoScope Analysis exports a ramp: extend and retract side by side, heights downward."""
    rows = {"Ex": tapping_rows(), "Rt": tapping_rows(retract=True)}
    columns = {f"Calc_Ramp_{way}_nm": -offset for way, (offset, _, _) in rows.items()}
    columns |= {f"Amplitude_{way}_mV": 1e3 * amplitude / 50.0 for way, (_, amplitude, _) in rows.items()}
    return separated(columns | {f"Phase_{way}_Deg": lag for way, (_, _, lag) in rows.items()}, "\t")


def nanonis_ramp() -> str:
    """Return a Nanonis Z ramp of `tapping_rows`: heights that grow away from the sample, forward and backward."""
    offset, amplitude, lag = tapping_rows()
    names = ["Z rel (m)", "Amplitude (m)", "Phase (deg)", "Amplitude [bwd] (m)", "Phase [bwd] (deg)"]
    rows = zip(-1e-9 * offset, 1e-9 * amplitude, lag, 1e-9 * amplitude, lag, strict=True)
    lines = ["Experiment\tZ spectroscopy\t", "f0 (Hz)\t90000\t", "", "[DATA]", "\t".join(names)]
    return "\n".join([*lines, *("\t".join(f"{cell:.9E}" for cell in row) for row in rows)]) + "\n"
