"""Change the kernels of the update statement by statement and tell what no test notices.

    python scripts/mutate_kernels.py [ROOM|ROOM.KERNEL ...]

A room is a module of the library, as ``estimation/update/bearing`` (``TESTS_OF`` lists them with
their tests; all where none is named). The kernels run as plain Python here
(NUMBA_DISABLE_JIT), so that a change needs no compiling. Exit code 1 where a change survives.
"""

from __future__ import annotations

import ast
import copy
import os
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

os.environ["NUMBA_DISABLE_JIT"] = "1"

import pytest

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "ros2_ws/src/netpos/test"
# Tests that have to notice; without what takes long in Python.
TESTS_OF = {
    "estimation/update/bearing": "test_bearing.py",
    "estimation/update/conditioning": "test_conditioning.py",
    "estimation/forms/ekf": "test_motion.py test_ekf.py test_ekf_gate.py "
    "test_ekf_contradiction.py test_ekf_iteration.py test_ekf_bending.py "
    "test_bearing.py test_ekf_wide_prior.py",
    "estimation/spatial/error_state": "test_error_state_rules.py test_error_state_chunks.py "
    "test_error_state.py",
    "estimation/factor": "test_factor.py",
    "estimation/update/fit": "test_fit.py test_gate.py "
    "test_mixing.py::test_likelihood_of_what_says_the_same_twice",
    "estimation/update/fusion": "test_ekf.py",
    "estimation/update/gate": "test_gate.py test_kf.py",
    "estimation/update/iteration": "test_ekf_iteration.py test_ekf_bending.py "
    "test_ekf_wide_prior.py",
    "estimation/forms/kf": "test_kf.py test_gate.py",
    "estimation/level/manoeuvre": "test_manoeuvre.py",
    "estimation/measurement": "test_measurement.py test_measurement_curvature.py "
    "test_measurement_phase.py test_measurement_rows.py test_step_velocity.py "
    "sensors/test_models.py",
    **{
        f"estimation/motion/{name}": "test_motion.py test_motion_models.py"
        for name in (
            *("constant_velocity", "constant_turn", "constant_acceleration", "stationary"),
            *("inertial", "rigid_body", "process", "process_noise"),
        )
    },
    "estimation/fixes/position_fix": "test_position_fix.py",
    "estimation/update/slow_errors": "test_slow_errors.py",
    "estimation/update/robust": "test_robust.py",
    "estimation/rows": "test_measurement_rows.py test_measurement_phase.py",
    "estimation/forms/sigma": "test_ukf.py",
    "estimation/smooth": "test_smooth.py",
    "estimation/spatial/space": "test_space.py test_space_conditioning.py sensors/test_models.py",
    "estimation/forms/srukf": "test_ukf.py test_engine_parts.py -knot+ten_thousand",
    **{
        f"estimation/sensors/{name}": "sensors/test_models.py test_measurement.py test_space.py "
        "test_measurement_curvature.py test_measurement_phase.py test_step_velocity.py"
        for name in (
            *("azimuth", "elevation", "cone_angle", "range", "phase", "position"),
            *("ground_speed", "step_velocity", "body_motion", "geometry"),
        )
    },
    "estimation/engine": "test_engine_parts.py test_engine.py -knot+equals_the_tracker",
    "estimation/update/predicted": "test_manoeuvre.py test_fit.py test_protection.py",
    "estimation/mixture/window": "../tracking/test_initialise_fit.py",
    "tracking/output": "test_output.py",
    "estimation/fixes/phase_fix": "test_phase_fix.py",
    "estimation/level/protection": "test_protection.py",
    "estimation/level/report": "test_report.py",
    "estimation/mixture/mixing": "test_mixing.py -knot+stop_straight_turn",
    **{
        f"estimation/mixture/{name}": "test_components.py "
        "-knot+grid+and+not+very_many+and+not+near_anchors+and+not+two_anchors"
        for name in (
            *("candidates", "epoch", "gaussians", "reduction", "turns"),
            *("in_turn", "splits/choice", "splits/paths", "splits/ring"),
        )
    },
    "estimation/mixture/sectors": "test_phase_sectors.py",
    "estimation/forms/ukf": "test_ukf.py test_gate.py",
}
# Newton's method gets there from anywhere.
_START = (
    "-2.0 * log_risk",
    "circular - math.log(1.0 + math.pi / 2.0 * circular * (1.0 - ratio))",
    "math.pi / 2.0 * circular * (1.0 - ratio)",
    "math.pi / 2.0 * circular",
    "1.0 - ratio",
    "math.pi / 2.0",
)
# Changes that change nothing but time, or nothing at all.
EQUIVALENT = {
    ("estimation/update/bearing", "_moments", "left out: continue"),  # the sums begin anew
    (
        "estimation/update/bearing",
        "fuse_bearing",
        "operator swapped: high - low",
    ),  # nearer still than it has to be
    (
        "estimation/update/bearing",
        "fuse_bearing",
        "operator swapped: reach - 0.5 * a[0]",
    ),  # ends beyond all weight
    ("estimation/measurement", "wrap", "operator swapped: angle + math.pi"),  # a whole turn away
    *(  # both are squared
        ("estimation/sensors/range", "exact", f"operator swapped: {sum_}")
        for sum_ in ("Pd += cov[i, j] * d[j]", "along += d[i] * Pd")
    ),
    ("estimation/forms/srukf", "_eliminate", "left out: continue"),
    ("estimation/forms/sigma", "_regress", "left out: E[i, n] *= _SHIFT_WEIGHT"),  # is 1
    ("estimation/forms/sigma", "_regress", "operator swapped: E[i, n] *= _SHIFT_WEIGHT"),
    ("estimation/forms/ekf", "_passes", "operator swapped: stop - start"),
    (
        "estimation/spatial/error_state",
        "correct",
        "left out: posterior = cov",
    ),  # set anew by the first iteration
    *(  # starts lie symmetrically around
        (
            "estimation/update/iteration",
            "refine_used",
            f"operator swapped: start[X.{a}] += 1.5 * math.sqrt"
            f"(prior_cov[X.{a}, X.{a}]) * math.{f}(2.0 * math.pi * k / _STARTS)",
        )
        for a, f in (("PX", "cos"), ("PY", "sin"))
    ),
    (
        "estimation/update/iteration",
        "refine_used",
        "operator swapped: cost - 0.001",
    ),  # the same place again
    *(
        ("estimation/level/protection", "gaussian_radius", f"operator swapped: {where}")
        for where in _START
    ),
    # one that converges as fast, and terms too small for the sum
    ("estimation/level/protection", "gaussian_radius", "operator swapped: 1e-06 * u"),
    ("estimation/level/protection", "gaussian_radius", "operator swapped: u + 2.0 * _NEGLIGIBLE"),
    (
        "estimation/level/protection",
        "radius_of",
        "operator swapped: xx + yy",
    ),  # finite where both are
    # is 1
    ("estimation/mixture/sectors", "_take_turns", "operator swapped: _WIDE_RAD * _WIDE_RAD"),
    *(  # memory for more rows than there are
        ("estimation/engine", "run_epochs", f"operator swapped: {size}")
        for size in ("row_start[k + 1] - row_start[k] (2)", "k + 1 (3)")
    ),
    (
        "estimation/update/iteration",
        "iterate_from",
        "left out: x, P = (mean.copy(), cov.copy())",
    ),  # likewise
}
CPU_S = 30  # what takes longer does not end
SWAPS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}


def swap(node: ast.AST) -> None:
    """Turn + into -, * into /, and back."""
    assert isinstance(node, ast.BinOp | ast.AugAssign)
    node.op = SWAPS[type(node.op)]()


def negate(node: ast.AST) -> None:
    """Let an ``if`` decide otherwise."""
    assert isinstance(node, ast.If)
    node.test = ast.UnaryOp(ast.Not(), node.test)


def drop(node: ast.AST) -> None:
    """Leave a statement out."""
    node.__class__ = ast.Pass
    node.__dict__ = {k: v for k, v in node.__dict__.items() if k in ast.Pass._attributes}


def mutants(function: ast.FunctionDef) -> Iterator[tuple[int, str, ast.FunctionDef]]:
    """Line, description and changed copy of every change to a function's body; of several alike
    the second is marked (2), and so on."""
    alike: Counter[str] = Counter()
    for index, node in enumerate(ast.walk(function)):
        changes: list[tuple[str, Callable[[ast.AST], None]]] = []
        if isinstance(node, ast.AugAssign | ast.Continue | ast.Assign) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        ):
            changes.append(("left out", drop))
        if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in SWAPS:
            changes.append(("operator swapped", swap))
        if isinstance(node, ast.If):
            changes.append(("condition negated", negate))
        for what, change in changes:
            changed = copy.deepcopy(function)
            target = list(ast.walk(changed))[index]
            text = f"{what}: {ast.unparse(node.test if isinstance(node, ast.If) else node)}"
            alike[text] += 1
            change(target)
            yield node.lineno, text + f" ({alike[text]})" * (alike[text] > 1), changed


def is_noticed(kernel: Callable[..., object], changed: ast.FunctionDef, tests: list[str]) -> bool:
    """Whether a test fails, or does not end, with the kernel's code replaced, in a process of its
    own."""
    child = os.fork()
    if child == 0:
        with open(os.devnull, "w", encoding="utf-8") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
        signal.setitimer(signal.ITIMER_VIRTUAL, CPU_S)
        changed.decorator_list = []
        module = ast.fix_missing_locations(ast.Module([changed], []))
        namespace: dict[str, Callable[..., object]] = {}
        exec(compile(module, "mutant", "exec"), dict(kernel.__globals__), namespace)
        kernel.__code__ = namespace[changed.name].__code__
        os._exit(run(tests))
    return os.waitpid(child, 0)[1] != 0


def run(tests: list[str]) -> int:
    """Exit code of the tests, stopped at the first that fails."""
    warnings.simplefilter("ignore")
    quiet = ["-x", "-q", "--no-header", "-p", "no:warnings", "-p", "no:timeout"]
    return int(pytest.main([*quiet, *tests]))


def kernels(module: ModuleType) -> Iterator[ast.FunctionDef]:
    """What a module compiles."""
    source = Path(str(module.__file__))
    for node in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
            if decorators & {"kernel", "leaf", "inlined"}:
                yield node


def survivors(
    room: str, kernel: Callable[..., object], node: ast.FunctionDef, tests: list[str]
) -> Iterator[bool]:
    """Of each change to a kernel, whether it went unnoticed, which is printed.

    Raises ``SystemExit`` where the tests fail without any change, or ``EQUIVALENT`` has a change
    of this kernel that is none.
    """
    if is_noticed(kernel, copy.deepcopy(node), tests):
        raise SystemExit(f"{room}: the tests fail without any change")
    known = {what for where, name, what in EQUIVALENT if (where, name) == (room, node.name)}
    for line, what, changed in mutants(node):
        if what in known:
            known.remove(what)
            continue
        unnoticed = not is_noticed(kernel, changed, tests)
        if unnoticed:
            print(f"{room}.py:{line} {node.name}: {what}", flush=True)
        yield unnoticed
    if known:
        raise SystemExit(f"{room}.{node.name} has no {known}; correct EQUIVALENT")


def main(rooms: list[str]) -> int:
    """Print what survives; how many do."""
    os.chdir(ROOT)
    unnoticed = total = 0
    for asked in rooms or list(TESTS_OF):
        room, _, only = asked.partition(".")
        module = import_module("netpos." + room.replace("/", "."))
        tests = [
            name.replace("+", " ")
            if name.startswith("-")
            else str(TESTS / room.split("/")[0] / name)
            for name in TESTS_OF[room].split()
        ]
        run([*tests, "--collect-only", "-qq"])  # imports what all children need
        for node in kernels(module):
            if only in ("", node.name):
                survived = list(survivors(room, getattr(module, node.name), node, tests))
                total, unnoticed = total + len(survived), unnoticed + sum(survived)
        print(f"{asked}: {total} changes so far, {unnoticed} not noticed", flush=True)
    return unnoticed


if __name__ == "__main__":
    sys.exit(1 if main(sys.argv[1:]) else 0)
