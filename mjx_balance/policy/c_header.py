"""Exports a policy as one C header: weights, robot and controller (`runtime.h.in`).

The header is `mjx_balance/runtime.py` in C. Tests compile it and compare the two.
"""

from collections.abc import Iterable
from importlib import resources
from pathlib import Path

import numpy as np

from mjx_balance import runtime
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.policy.manifest import installed_version
from mjx_balance.runtime import Controller, Model

TEMPLATE = "runtime.h.in"
SENSORS = {"height": 0, "command": 1, "gyro": 2, "accelerometer": 2}
"""Where a row's samples are: foot heights, commands, IMU; 3 is a leaky mean."""
ROW = """typedef struct {
    uint8_t sensor, index;
    uint16_t lag, window, scale; /* lag: of a leaky mean, its place; scale: a row of mjxb_scales */
} mjxb_row;
"""


def export_header(path: Path, out: Path, fingerprint: str) -> int:
    """Writes a policy as a C header, atomically.

    Args:
      path: of the policy file.
      out: file to write.
      fingerprint: of the weights, for its first line.

    Returns:
      Size of the file, bytes.

    Raises:
      PolicyFileError: if the runtime cannot run the policy.
      OSError: if `out` cannot be written; an old file then stays.
    """
    version = installed_version("mjx_balance") or ""
    about = f"Policy {fingerprint}, written by `mjx-balance export`, mjx_balance {version}."
    template = resources.files("mjx_balance.policy").joinpath(TEMPLATE).read_text()
    text = template.replace("@ABOUT@", about)
    content = text.replace("@CONSTANTS@", constants(Controller(path).model)).encode()
    write_atomically(out, content)
    return len(content)


def constants(model: Model) -> str:
    """Returns the policy's numbers as C: sizes and limits as macros, all else as arrays."""
    legs, network = model.legs, model.network
    inputs = model.inputs
    decision, history = model.decision_samples, model.history
    recent = model.recent
    hidden = [bias.size for _, bias in network.layers[:-1]]
    outputs = network.layers[-1][1].size
    width = max(*map(len, (kernel for kernel, _ in network.layers)), *hidden, outputs)
    latest = (recent - 1) // 3
    low, high = legs.limits()
    macros: dict[str, float | str] = {
        "LEGS": len(model.joints),
        "JOINTS": 3 * len(model.joints),
        "SAMPLE_S": model.sample_dt,
        "DECISION": decision,
        "RAMP": len(model.share),
        "HISTORY": history,
        "RECENT": recent,
        "SPAN": max(recent, decision),
        "LATEST": latest,
        "LATEST_LEAST": int(latest * runtime.LIVELY),
        "LIVE_IMU": max(2, round(runtime.LIVELY * recent)),
        "LIVE_SENSOR": max(2, round(runtime.LIVELY_SENSOR * recent)),
        "POSES": -(-recent // decision),
        "COMMANDS": inputs.lookback("command"),
        "MEANS": len(inputs.slow),
        "INPUTS": inputs.size,
        "HIDDEN": len(hidden),
        "OUTPUTS": outputs,
        "WIDTH": width,
        "FACTORS": len(network.factors),
        "RADIAL": int(network.radial),
        "CONTINUOUS": int(model.continuous),
        "HAS_GAINS": int(model.gains is not None),
        "HAS_TRIM": int(model.gains is not None and model.trim is not None),
        "BODY_HEIGHT": model.height,
        "LOWEST": legs.height_range[0],
        "HIGHEST": legs.height_range[1],
        "GYRO_MOST": runtime.GYRO_MOST,
        "ACCEL_MOST": runtime.ACCEL_MOST,
        "LYING_MORE": runtime.LYING_SLACK - runtime.KNEE_SLACK,
        "WEIGHT_LEAST": runtime.WEIGHT[0],
        "WEIGHT_MOST": runtime.WEIGHT[1],
        "LEAN_MOST": runtime.LEAN_MOST,
        "TILT_MOST": runtime.TILT_MOST,
        "NORM_ERROR": runtime.NORM_ERROR,
        "RATE_MOST": model.rate_most,
        "AWAY_MOST": runtime.AWAY_MOST,
        "MOVED_LEAST": runtime.MOVED_LEAST,
        "STUCK_MOST": runtime.STUCK_MOST,
        "STILL_RATE": runtime.STILL_RATE,
        "LATE_S": runtime.LATE_SAMPLES * model.sample_dt,
        "GAIN_RISE": max(1, round(runtime.GAIN_RISE_S / model.sample_dt)),
        "STAND_SPEED": runtime.STAND_SPEED,
        "LEAST_MOVE_S": runtime.LEAST_MOVE_S,
        "STEEPEST": runtime.STEEPEST,
        "DEGREES": float(np.degrees(1.0)),
    }
    lines = [f"#define MJXB_{name} {_literal(value)}" for name, value in macros.items()]
    names = [", ".join(map(c_string, leg)) for leg in model.joints]
    lines.append("#define MJXB_JOINT_NAMES {" + ", ".join(f"{{{leg}}}" for leg in names) + "}")
    doubles: dict[str, Iterable[float]] = {
        "thigh": legs.thigh,
        "calf": legs.calf,
        "drop": legs.drop,
        "offset": legs.offset,
        "rise": legs.rise,
        "lift": legs.lift,
        "bends": legs.bends,
        "left": legs.sides[0],
        "front": legs.sides[1],
        "signs": legs.signs.ravel(),
        "zeros": legs.zeros.ravel(),
        "least": low,
        "most": high,
        "torque_limits": model.torque_limits.ravel(),
    }
    if model.gains is not None:
        doubles["stiffness"], doubles["damping"] = model.gains.reshape(2, -1)
        if model.trim is not None:
            doubles["trim"] = model.trim.ravel()
    if inputs.slow:
        means = inputs.means
        doubles |= {"mean_starts": means.first, "mean_leaks": means.leak}
        times = np.zeros(len(inputs.slow))
        times[means.angle] = means.times
        doubles["mean_times"] = times
        lines.append(_array("int", "mean_places", map(str, means.places)))
    lines += [_array("double", name, map(_literal, x)) for name, x in doubles.items()]
    lines += [_array("int", "hidden_sizes", map(str, hidden or [0]))]
    lines += [_array("int", "factors", map(str, network.factors))]
    if model.continuous:
        lines += [
            _array("float", name, map(_float, values))
            for name, values in zip(
                ("middle", "half"), np.stack((model.middle, model.half)), strict=True
            )
        ]
    else:
        rows = [f"{{{_literal(x)}, {_literal(y)}}}" for x, y in model.table]
        lines.append(_array("double", "table", rows, "[2]"))
    slow = {place: k for k, place in enumerate(inputs.slow)}
    rows, scales = [], {}
    for k, row in enumerate(model.manifest["inputs"]):
        if k in slow:
            places = (3, 0, slow[k], 1)
        else:
            index = row["index"] + 3 * (row["sensor"] == "accelerometer")
            places = (SENSORS[row["sensor"]], index, row["lag"], row["window"])
        pair = f"{{{_literal(inputs.offset[k])}, {_literal(inputs.scale[k])}}}"
        rows.append(f"{{{', '.join(map(str, places))}, {scales.setdefault(pair, len(scales))}}}")
    lines += [ROW, _array("mjxb_row", "rows", rows)]
    lines.append(_array("double", "scales", scales, "[2]"))
    weights = [array.ravel() for layer in network.layers for array in layer]
    lines.append(_array("float", "weights", map(_float, np.concatenate(weights))))
    return "\n".join(lines) + "\n"


def c_string(text: str) -> str:
    """Text as a C literal: what is not a plain character of ASCII becomes octal bytes."""
    plain = [
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in text.encode("utf-8", "replace")
    ]
    return '"' + "".join(plain) + '"'


def _array(kind: str, name: str, values: Iterable[str], inner: str = "") -> str:
    body, line = [], "   "
    for value in values:
        if len(line) + len(value) > 98:
            body.append(line)
            line = "   "
        line += f" {value},"
    return "\n".join((f"static const {kind} mjxb_{name}[]{inner} = {{", *body, line, "};"))


def _literal(value: float | str) -> str:
    if isinstance(value, int | np.integer | str):
        return str(value)
    if np.isinf(value):
        return "HUGE_VAL"
    text = repr(float(value))
    return text if value >= 0 and text[0] != "-" else f"({text})"


def _float(value: float) -> str:
    text = repr(np.float32(value).item()) if value == 0 else f"{np.float32(value):.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"
