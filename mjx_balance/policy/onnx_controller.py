"""Exports a policy with its memory as an ONNX model: samples of the sensors in, joint targets out.

The graph is what `mjx_balance/runtime.py` does while it balances, without its checks. It computes
in float64 where the runtime does: foot heights add up over the decisions, the leaky means over
minutes, and a sum that is rounded the other way can choose another action of the grid.
"""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto
from onnx.reference import ReferenceEvaluator

from mjx_balance.files.run_folder import write_atomically
from mjx_balance.policy.onnx import Graph, Tensors, best_action, best_point
from mjx_balance.runtime import IMU, Controller, Model, State

ABOUT = (
    "Controller of mjx_balance: a sample of the sensors and the state in, joint targets (rad) and "
    "the next state out. A state of zeros begins; the robot then stands still at its standing "
    "height. Joints are in the order of robot.legs in the metadata's manifest, `timing` there says "
    "how often a sample is due. It does not check readings: one that is not finite makes all "
    "targets NaN until it begins again."
)
AGREE = 1e-6  #: greatest difference of a target from the runtime's, rad
CHECKED = 2  #: decisions that are compared with the runtime's at export


def export_controller(path: Path, out: Path) -> tuple[int, int]:
    """Writes the controller of a policy as an ONNX model, atomically.

    Args:
      path: of the policy file.
      out: file to write.

    Returns:
      Size of the file, bytes, and of the state.

    Raises:
      PolicyFileError: if the runtime cannot run the policy.
      RuntimeError: if the model's targets are not those of the runtime.
      OSError: if `out` cannot be written; an old file then stays.
    """
    model = controller_model(Controller(path).model)
    _check(model, path)
    content = model.SerializeToString()
    write_atomically(out, content)
    return len(content), model.graph.input[-1].type.tensor_type.shape.dim[0].dim_value


def controller_model(model: Model) -> onnx.ModelProto:
    """Returns what a controller does while it balances as an ONNX model of one sample.

    All is float64 but `decided`. Inputs: `joint_positions` (legs, 3) rad, `gyro` (3,) rad/s,
    `accelerometer` (3,) m/s^2 and `state` (n,), which is zero at first. Outputs: `targets`
    (legs, 3) rad, `command` (2,) height changes of the last decision, m, `decided` (), whether this
    sample made a decision, and `next_state` (n,). The metadata holds `manifest` as JSON.
    """
    graph = Graph()
    legs, samples = len(model.joints), model.inputs.lookback("gyro", "accelerometer")
    rows = max(
        model.inputs.lookback("command"), 2
    )  # the ramp goes from the last but one to the last
    means = len(model.inputs.slow)
    sizes = [1, 2, rows * legs, samples * IMU, means, means]
    sizes = sizes if means else sizes[:-2]
    parts = [f"state_{k}" for k in range(len(sizes))]
    graph.split("state", sizes, parts)
    count, command, commands, imu, *leaky = parts

    first = graph.add("Equal", count, np.zeros(1))
    due = graph.add("Equal", count, np.asarray([float(model.decision_samples)]))
    decides = graph.add("Or", first, due)
    sample = graph.add("Concat", "gyro", "accelerometer", axis=0)
    imu = graph.add("Reshape", imu, np.asarray([samples, IMU]))
    imu = graph.add("Where", first, sample, _pushed(graph, imu, sample, samples))
    commands = graph.add("Reshape", commands, np.asarray([rows, legs]))
    commands = graph.add("Where", first, np.asarray(model.height), commands)
    if means:
        leaky = _leaky_means(graph, model.inputs.means, sample, first, leaky)

    heights = _foot_heights(graph, model.legs, "joint_positions")
    observation = _observation(graph, model.inputs, heights, commands, imu, leaky, rows, samples)
    out = _network(graph, model.network, observation)
    command = graph.add("Where", decides, _command(graph, model, out), command)

    before = graph.columns(commands, rows - 1, rows, axis=0)
    changes = graph.add("MatMul", command, model.legs.sides)
    after = graph.add(
        "Clip", graph.add("Add", before, changes), *map(np.asarray, model.legs.height_range)
    )
    commands = graph.add("Where", decides, _pushed(graph, commands, after, rows), commands)
    count = graph.add("Where", decides, np.ones(1), graph.add("Add", count, np.ones(1)))

    ramp = float(len(model.share))
    share = graph.add("Div", graph.add("Min", count, np.asarray(ramp)), np.asarray(ramp))
    before, after = (graph.columns(commands, k, k + 1, axis=0) for k in (rows - 2, rows - 1))
    rest = graph.add("Mul", before, graph.add("Sub", np.ones(1), share))
    heights = graph.add("Add", rest, graph.add("Mul", after, share))
    targets = _joint_angles(graph, model.legs, graph.add("Reshape", heights, np.asarray([legs])))

    # 0, or NaN once a reading or an output of the network is not finite; the count keeps that.
    values = [graph.flat(x) for x in ("joint_positions", out)]
    values[1] = graph.add("Cast", values[1], to=TensorProto.DOUBLE)
    none = graph.add("Mul", graph.add("Concat", *values, sample, count, axis=0), np.asarray(0.0))
    spoilt = graph.add("ReduceSum", none, np.asarray([0]))
    count = graph.add("Add", count, spoilt)
    graph.add("Add", targets, spoilt, output="targets")
    graph.add("Add", command, spoilt, output="command")
    graph.add("Squeeze", decides, output="decided")
    state = [count, "command", graph.flat(commands), graph.flat(imu), *leaky]
    graph.add("Concat", *state, axis=0, output="next_state")

    real, state = np.float64, (np.float64, (sum(sizes),))
    joints, axes = (real, (legs, 3)), (real, (3,))
    inputs: Tensors = {"joint_positions": joints, "gyro": axes, "accelerometer": axes}
    outputs: Tensors = {"targets": joints, "command": (real, (2,)), "decided": (np.bool_, ())}
    inputs["state"] = outputs["next_state"] = state
    return graph.model("controller", ABOUT, inputs, outputs, model.manifest)


def _check(model: onnx.ModelProto, path: Path) -> None:
    """Compares the model's targets with the runtime's at the noisy samples of a standing robot."""
    now, rng, evaluator = 0.0, np.random.default_rng(0), ReferenceEvaluator(model)
    runtime = Controller(path, lambda: now)
    legs, size = (x.type.tensor_type.shape.dim[0].dim_value for x in model.graph.input[::3])
    state, error = np.zeros(size), 0.0
    for _ in range(CHECKED * runtime.decision_samples + 1):
        now += runtime.sample_dt
        joints = runtime.targets + rng.normal(0, 0.01, (legs, 3))
        imu = rng.normal((0, 0, 0, 0, 0, 9.81), 0.02)
        expected = runtime.step(joints, imu[:3], imu[3:])
        inputs = {"joint_positions": joints, "gyro": imu[:3], "accelerometer": imu[3:]}
        targets, *_, state = evaluator.run(None, inputs | {"state": state})
        error = max(error, float(np.abs(targets - expected).max()))  # pyright: ignore
    if not error <= AGREE or runtime.state is not State.BALANCING:
        raise RuntimeError(
            f"the model's targets differ from the runtime's by {error:.2g} rad; onnx "
            f"{onnx.__version__} may not be able to write it"
        )


def _pushed(graph: Graph, rows: str, row: str, count: int) -> str:
    """`count` rows without the first, and another one at their end."""
    others = graph.columns(rows, 1, count, axis=0)
    row = graph.add("Reshape", row, np.asarray([1, -1]))
    return graph.add("Concat", others, row, axis=0)


def _leaky_means(
    graph: Graph, means: Any, sample: str, first: str, sums_and_weights: list[str]
) -> list[str]:
    """Sums and weights after a sample, as `runtime._Means`."""
    values = sample
    if means.angle.any():
        x, y, z = (graph.columns(sample, 3 + k, 4 + k, axis=0) for k in range(3))
        across = graph.add("Sqrt", graph.add("Add", *(graph.add("Mul", k, k) for k in (y, z))))
        pitch = _angle(graph, graph.add("Neg", x), across)
        values = graph.add("Concat", sample, _angle(graph, y, z), pitch, axis=0)
    values = graph.add("Gather", values, means.places)
    if means.angle.any():
        times, turns = np.zeros(len(means.places)), np.zeros(len(means.places), int)
        times[means.angle], turns[means.angle] = means.times, means.turns
        turned = graph.add("Mul", graph.add("Gather", sample, turns), times)
        values = graph.add("Add", values, turned)
    starts = (graph.add("Mul", values, means.first), means.first)
    result = []
    for old, start, new in zip(sums_and_weights, starts, (values, np.ones(1)), strict=True):
        step = graph.add("Mul", graph.add("Sub", new, old), means.leak)
        result.append(graph.add("Where", first, start, graph.add("Add", old, step)))
    return result


def _observation(
    graph: Graph,
    inputs: Any,
    heights: str,
    commands: str,
    imu: str,
    leaky: list[str],
    rows: int,
    samples: int,
) -> str:
    """The network's inputs (1, size), float32, as `runtime._Inputs`."""
    legs = inputs.channels
    pool = graph.add("Concat", heights, graph.flat(commands), graph.flat(imu), axis=0)
    # Sensor: where its newest sample is in the pool, and how far apart its samples are.
    last = legs * rows, legs * (1 + rows) + IMU * (samples - 1)
    newest = {"height": (0, legs), "command": (last[0], legs)}
    newest |= {"gyro": (last[1], IMU), "accelerometer": (last[1] + 3, IMU)}
    values, places = [], []
    if leaky:
        values.append(graph.add("Div", *leaky))
        places += inputs.slow
    for sensor, group, steps, index in inputs.groups:
        start, stride = newest[sensor]
        sought = (start + (steps + 1) * stride + index).astype(np.int32)
        values.append(
            graph.add("ReduceMean", graph.add("Gather", pool, sought), axes=[0], keepdims=0)
        )
        places += group.tolist()
    value = graph.add("Gather", graph.add("Concat", *values, axis=0), np.argsort(places))
    value = graph.add("Div", graph.add("Sub", value, inputs.offset), inputs.scale)
    value = graph.add("Cast", value, to=TensorProto.FLOAT)
    return graph.add("Reshape", value, np.asarray([1, -1]))


def _network(graph: Graph, network: Any, observation: str) -> str:
    """Outputs (1, n) of the network, float32, as `runtime._Network`: its sums are in float64."""
    x = observation
    for k, (kernel, bias) in enumerate(network.layers):
        if k == len(network.layers) - 1 and network.radial:
            x = graph.add("Concat", x, observation, axis=1)
        # The file holds weights as float32; a session makes float64 of them once.
        arrays = (x, kernel.astype(np.float32), bias.astype(np.float32))
        double = (graph.add("Cast", y, to=TensorProto.DOUBLE) for y in arrays)
        x = graph.add("Cast", graph.add("Gemm", *double), to=TensorProto.FLOAT)
        if k < len(network.layers) - 1:
            x = graph.add("Relu", x)
    return x


def _command(graph: Graph, model: Model, out: str) -> str:
    """Height changes (2,) of the best action, m."""
    network = model.network
    if model.continuous:
        point = graph.add("Mul", best_point(graph, out, 2), model.half)
        command = graph.add("Add", point, model.middle)
        command = graph.add("Cast", command, to=TensorProto.DOUBLE)
    else:
        action = best_action(graph, out, network.factors, network.radial)
        command = graph.add("Gather", model.table, action)
    return graph.flat(command)


def _foot_heights(graph: Graph, legs: Any, angles: str) -> str:
    """(legs,) m for joint angles (legs, 3), as `runtime._Legs`."""
    turned = graph.add("Add", graph.add("Mul", angles, legs.signs), legs.zeros)
    abduction, thigh, knee = (graph.add("Gather", turned, np.asarray(k), axis=1) for k in range(3))
    upper = graph.add("Mul", graph.add("Cos", thigh), legs.thigh)
    lower = graph.add("Mul", graph.add("Cos", graph.add("Add", thigh, knee)), legs.calf)
    length = graph.add("Add", graph.add("Add", upper, lower), legs.drop)
    down = graph.add("Mul", length, graph.add("Cos", abduction))
    aside = graph.add("Mul", graph.add("Sin", abduction), legs.offset)
    return graph.add("Add", graph.add("Sub", down, aside), legs.lift)


def _joint_angles(graph: Graph, legs: Any, heights: str) -> str:
    """(legs, 3) rad for foot heights (legs,), as `runtime._Legs`."""
    a, b = legs.thigh, legs.calf
    length = graph.add("Sub", heights, legs.rise)
    cosine = graph.add("Sub", graph.add("Mul", length, length), a**2 + b**2)
    one = np.asarray(1.0)
    cosine = graph.add("Clip", graph.add("Div", cosine, 2 * a * b), -one, one)
    square = graph.add("Mul", graph.add("Sub", one, cosine), graph.add("Add", one, cosine))
    sine = graph.add("Mul", graph.add("Sqrt", square), legs.bends)
    knee = _angle(graph, sine, cosine)
    ahead = graph.add("Add", graph.add("Mul", cosine, b), a)
    thigh = graph.add("Neg", _angle(graph, graph.add("Mul", sine, b), ahead))
    zero = graph.add("Mul", thigh, np.asarray(0.0))
    columns = [graph.add("Unsqueeze", x, np.asarray([1])) for x in (zero, thigh, knee)]
    turned = graph.add("Sub", graph.add("Concat", *columns, axis=1), legs.zeros)
    return graph.add("Mul", turned, legs.signs)


def _angle(graph: Graph, y: str, x: str) -> str:
    """atan2(y, x) in float64.

    ONNX has no atan2, and onnxruntime no arctangent of float64: one of float32 is the first guess,
    and a step of Newton's method takes its error from 1e-7 to 1e-16.
    """
    square = graph.add("Add", graph.add("Mul", x, x), graph.add("Mul", y, y))
    radius = graph.add("Max", graph.add("Sqrt", square), np.asarray(1e-300))
    # tan of half the angle; each of the two forms loses digits where the other does not.
    ahead = graph.add("Div", y, graph.add("Add", radius, x))
    behind = graph.add("Div", graph.add("Sub", radius, x), y)
    half = graph.add("Where", graph.add("Less", x, np.asarray(0.0)), behind, ahead)
    guess = graph.add("Atan", graph.add("Cast", half, to=TensorProto.FLOAT))
    guess = graph.add("Cast", graph.add("Add", guess, guess), to=TensorProto.DOUBLE)
    ahead = graph.add("Mul", y, graph.add("Cos", guess))
    behind = graph.add("Mul", x, graph.add("Sin", guess))
    error = graph.add("Div", graph.add("Sub", ahead, behind), radius)
    return graph.add("Add", guess, error)
