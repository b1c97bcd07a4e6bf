"""How do policies do where sensors, servos and boards are as on a robot? Every suite, one table.

python benchmarks/suites.py best real [--write docs/results.md]
"""

import common
from common import Row

from mjx_balance.evaluation.controllers import make_controller
from mjx_balance.evaluation.rollout import observing, policy_scene
from mjx_balance.evaluation.suites import SUITES
from mjx_balance.policy.file import load_policy

BASELINE = "pd-imu"


def main() -> None:
    """Measures and prints."""
    parser = common.arguments(__doc__)
    parser.add_argument("policies", nargs="+", help="files, or names of shipped ones")
    parser.add_argument("--suites", nargs="+", default=list(SUITES), choices=SUITES)
    parser.add_argument("--scenarios", type=int, default=16)
    args = parser.parse_args()
    policies = {name: load_policy(name) for name in args.policies}
    columns = [(name, policy_scene(x), observing(x)) for name, x in policies.items()]
    scene = columns[0][1]
    columns.append((BASELINE, scene, make_controller(BASELINE, scene)))
    rows: list[Row] = []
    for suite in args.suites:
        common.log(f"{suite} ...")
        rows.append({"suite": suite})
        for name, own, controller in columns:
            result = common.evaluated(own, controller, suite, args.scenarios)
            rows[-1][name] = common.pooled([result])
    fell = any(row[name]["falls"] for row in rows for name, *_ in columns)
    falls = "falls in brackets, none elsewhere" if fell else "no falls"
    note = (
        f"{common.TILTS.capitalize()}, over {args.scenarios} held-out scenarios of "
        f"{common.DURATION:g} s; {falls}."
    )
    common.report(args, "suites", rows, note)


if __name__ == "__main__":
    main()
