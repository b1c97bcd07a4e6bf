"""The words of the command line: commands, flags and names, known before anything else is imported.

A word that is spelt wrong is refused within a fraction of a second, and `train` shows its first
line before it imports JAX and MuJoCo.
"""

import contextlib
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from mjx_balance.config import PRESETS, SWEEPABLE, Config, flatten, preset, to_dict
from mjx_balance.errors import PATH, USAGE_ERROR, InputError, quote, shorten, suggest
from mjx_balance.robots import shipped

HELP = ("-h", "--help")
HELP_ALL = "--help-all"


class Command(NamedTuple):
    """A command of `mjx-balance`."""

    function: str  #: `module:function` of this package; takes the words after it, returns a code
    summary: str
    example: str  #: the words after its name


COMMANDS = {
    "train": Command(
        "train:train", "train a policy, export it, evaluate it", "--preset quick --engine mujoco"
    ),
    "sweep": Command(
        "train:sweep", "train with several values of a number", "gamma=0.1,0.4 --num-seeds 4"
    ),
    "evaluate": Command(
        "evaluate:evaluate", "measure a policy in plain MuJoCo", "best --suite corner"
    ),
    "report": Command("report:report", "write an HTML page about runs", "runs/first"),
    "export": Command("export:export", "write a policy as ONNX or C", "best --out policy.h"),
    "replay": Command("replay:replay", "run a robot's log through a policy", "log.npz"),
    "view": Command("view:view", "watch a policy; keys tilt the board", "best"),
    "robot": Command("robot:robot", "draft or check your own robot's file", "check my_robot.toml"),
    "completion": Command("words:completion", "print a script for TAB completion", "bash"),
}
SUITES = (
    *("paper", "corner", "noise", "payload", "friction", "gains", "soft", "latency", "push"),
    *("fast", "steep", "recover", "steps", "sea", "platform", "bias", "encoder", "delay"),
    *("dropout", "shift", "slip", "weak"),
)
"""Names of `evaluation.suites.SUITES`, which imports MuJoCo."""
CONTROLLERS = ("none", "pd-imu", "pd-attitude", "rate-oracle", "clairvoyant")
"""Names of `evaluation.controllers.CONTROLLERS`, likewise."""
ENGINES = ("mjx", "mujoco", "warp")  #: those of `Config.engine`
SHELLS = ("bash", "zsh", "fish")


@dataclasses.dataclass(frozen=True)
class RunArgs:
    """The flags of `train` that are not fields of the config."""

    run_dir: Path | None = None
    """Folder to create for the run; none: runs/PRESET-SEED-TIME."""
    resume: Path | None = None
    """Run folder to continue, instead of a new one; its config sets all defaults."""
    track: Literal["wandb", "trackio"] | None = None
    """Send the metrics to Weights & Biases or to Trackio; none: only to TensorBoard's files."""
    profile: bool = False
    """Trace a call of the training program and print the share of time that each part takes."""
    distributed: bool = False
    """Train with several processes that Slurm, Open MPI or Kubernetes starts, on one machine or
    many; without one of these, use the next three flags instead. All other flags must be the same
    for all processes."""
    coordinator: str | None = None
    """HOST:PORT at which process 0 listens; none: the cluster sets it."""
    process_id: int | None = None
    """Index of this process, from 0."""
    num_processes: int | None = None
    """Number of processes."""


TRAIN_HELP = """\
usage: mjx-balance train [flags]

Train a policy, export it, and evaluate it in plain MuJoCo.

  mjx-balance train --preset quick --engine mujoco

  --preset NAME          {presets};
                         sets the defaults of all other flags (default)
  --engine NAME          physics: mjx, on any device; mujoco, faster on CPUs; or
                         warp, on NVIDIA GPUs (mjx)
  --robot ROBOT          a shipped robot's name, a TOML file, menagerie:NAME, or
                         module:NAME of your own (quadruped)
  --seed N               random seed (0)
  --num-seeds N          seeds to train at once; the best is exported (1)
  --num-env-steps N      decisions of a run, over all envs (by preset)
  --num-envs N           envs simulated at once (sized to the device)
  --export last|best     export the last policy, or the one that
                         validated best (last)
  --run-dir DIR          folder to create (runs/PRESET-SEED-TIME)
  --resume DIR           run folder to continue, after Ctrl-C or a kill

Every number of task, randomisation and learner is a flag as well:
mjx-balance train --help-all lists them with units and sources.
"""
SWEEP_HELP = """\
usage: mjx-balance sweep NAME=VALUE,VALUE,... [@FILE ...] [train's flags]

Train every combination of values, with --num-seeds seeds each, in one program,
and rank the combinations.

  mjx-balance sweep gamma=0.1,0.4 learning_rate=0.01,0.003 --num-seeds 4

  NAME                   {sweepable}
  @FILE                  text file with such entries
  --resume DIR           run folder of a sweep to continue; give no entries

mjx-balance train --help lists the other flags.
"""


def overview() -> str:
    """The help of `mjx-balance`: its commands, each with an example."""
    rows = [
        f"  {name:<12}{command.summary}\n{'':14}mjx-balance {name} {command.example}"
        for name, command in COMMANDS.items()
    ]
    return (
        "usage: mjx-balance COMMAND ...\n\nBalance a quadruped on a tilting board with a DQN.\n\n"
        + "\n".join(rows)
        + "\n\nmjx-balance COMMAND --help lists its flags; --version prints the version."
    )


def command_help(name: str) -> str | None:
    """The help of a command whose flags are too many to list; None for the others."""
    if name == "train":
        return TRAIN_HELP.format(presets=", ".join(PRESETS))
    if name == "sweep":
        lines, line = [], ""
        for field in SWEEPABLE:
            if len(line) + len(field) > 50:
                lines.append(line.rstrip())
                line = ""
            line += f"{field}, "
        return SWEEP_HELP.format(sweepable=f"\n{'':25}".join([*lines, line[:-2]]))
    return None


def complain(message: str, code: int = USAGE_ERROR) -> int:
    """Prints an error message; returns the exit code."""
    print(f"mjx-balance: {shorten(message, PATH)}", file=sys.stderr)
    return code


def train_flags() -> list[str]:
    """All flags of `train`, in the order of its help."""
    names = [field.name for field in dataclasses.fields(RunArgs)] + list(flatten(to_dict(Config())))
    return [f"--{name.replace('_', '-')}" for name in names]


def value_of(argv: Sequence[str], flag: str, default: str = "") -> str:
    """The value of a flag among a command's words, the last one if there are several."""
    for k in reversed(range(len(argv))):
        name, _, value = argv[k].partition("=")
        if name == flag and (value or k + 1 < len(argv)):
            return value or argv[k + 1]
    return default


def check_words(name: str, argv: Sequence[str]) -> None:
    """Checks the names among a command's words; for `train`, also the flags.

    Raises:
      InputError: for an unknown one; the message suggests a known one.
    """
    if name == "completion":
        return
    if name == "robot" and argv and argv[0] not in (*HELP, "check", "new"):
        remedy = suggest("command", argv[0], ("check", "new"))
        raise InputError(f"unknown command 'robot {shorten(argv[0])}'; {remedy}")
    if name in ("train", "sweep"):
        known = train_flags()
        negated = [f"--no-{flag.removeprefix('--')}" for flag in known]
        for word in argv:
            flag = word.partition("=")[0].replace("_", "-")
            others = (*HELP, HELP_ALL, *negated)
            if flag.startswith("--") and flag not in known and flag not in others:
                remedy = suggest("flag", flag[2:], [own[2:] for own in known])
                if remedy.startswith("known"):
                    remedy = f"`mjx-balance train {HELP_ALL}` lists them all"
                remedy = remedy.replace("you mean ", "you mean --")
                raise InputError(f"unknown flag {shorten(flag)}; {remedy}")
    if chosen := value_of(argv, "--preset"):
        preset(chosen)
    names = {"suite": SUITES, "controller": CONTROLLERS, "robot": shipped()}
    for kind, known in names.items():
        value = value_of(argv, f"--{kind}")
        elsewhere = ":" in value or (kind == "robot" and value.endswith(".toml"))
        if value and value not in known and not elsewhere:
            prefix = f"robot is {quote(value)}" if kind == "robot" else f"unknown {kind} {value!r}"
            raise InputError(f"{prefix}; {suggest(kind, value, known)}")


def first_line(argv: Sequence[str]) -> None:
    """Says that a training begins, before JAX and MuJoCo are imported, which takes seconds.

    With several processes it prints nothing: none knows yet whether it is the first.
    """
    if {"--distributed", "--coordinator", "--process-id", "--num-processes"} & set(argv):
        return
    what = f"preset {value_of(argv, '--preset', 'default')}"
    if folder := value_of(argv, "--resume"):
        what = f"resuming {shorten(folder, PATH)}"
    with contextlib.suppress(OSError):  # nobody listens
        print(f"{what}: importing JAX and MuJoCo ...", flush=True)


SCRIPTS = {
    "bash": """\
_mjx_balance() {
    COMPREPLY=($(mjx-balance completion bash "${COMP_WORDS[@]:1:COMP_CWORD}"))
}
complete -o default -F _mjx_balance mjx-balance
""",
    "zsh": """\
_mjx_balance() {
    compadd -- $(mjx-balance completion zsh "${(@)words[2,CURRENT]}") || _files
}
compdef _mjx_balance mjx-balance
""",
    "fish": """\
complete -c mjx-balance -a '(mjx-balance completion fish (commandline -xpc)[2..] (commandline -ct))'
""",
}
"""Shell -> what makes it ask `mjx-balance completion SHELL WORDS...` for completions."""


def completion(argv: list[str]) -> int:
    """Runs `mjx-balance completion SHELL`; with more words, prints completions of the last."""
    shell, *words = argv or [""]
    if shell in HELP:
        print("usage: mjx-balance completion bash|zsh|fish\n\nPrint a script for the shell.")
        return 0
    if shell not in SHELLS:
        return complain(f"unknown shell {quote(shell)}; {suggest('shell', shell, SHELLS)}")
    print("\n".join(endings(words)) if words else SCRIPTS[shell], end="\n" if words else "")
    return 0


def endings(words: Sequence[str]) -> list[str]:
    """Completions of the last of a command's words; none where it may be a file."""
    *before, last = words
    values = {
        "--preset": tuple(PRESETS),
        "--engine": ENGINES,
        "--suite": SUITES,
        "--controller": CONTROLLERS,
        "--robot": shipped(),
        "--export": ("last", "best"),
        "robot": ("check", "new"),
        "completion": SHELLS,
    }
    if not before:
        known: Sequence[str] = tuple(COMMANDS)
    elif before[-1] in values:
        known = values[before[-1]]
    elif last.startswith("-") and before[0] in ("train", "sweep"):
        known = train_flags()
    else:
        known = ()
    return [word for word in known if word.startswith(last)]
