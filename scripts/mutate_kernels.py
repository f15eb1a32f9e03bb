"""Change the kernels of the update statement by statement and tell what no test notices.

    python scripts/mutate_kernels.py [ROOM|ROOM.KERNEL ...]

A room is a module of the filters (``KERNELS`` lists them; all where none is named). The kernels
run as plain Python here (NUMBA_DISABLE_JIT), so that a change needs no compiling. Exit code 1
where a change survives.
"""

from __future__ import annotations

import ast
import copy
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"

import pytest

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "ros2_ws/src/netpos/test/filters"
# Kernels changed, and the tests that have to notice; without what takes long in Python.
KERNELS = {
    "ekf": (
        "predict _predict_core _shear _predict_biased _predict_dense _small_nis _large_nis "
        "_passes _least_misfit gate update _fuse_used _odd_one_out _coloured_nis",
        "test_motion.py test_ekf.py test_ekf_gate.py test_ekf_contradiction.py "
        "test_ekf_iteration.py test_ekf_bending.py test_bearing.py test_ekf_wide_prior.py",
    ),
    "fusion": (
        "_project _fuse_rows _fuse_core _fuse_any fuse group_nis _pivots_exceed _exceeds "
        "is_definite keeps_digits fuse_by_factor",
        "test_ekf.py",
    ),
    "srukf": (
        "cholesky_update _down_date _rotate predict update fuse",
        "test_srukf.py -knot+ten_thousand",
    ),
    "iteration": (
        "iterate iterate_from bends iterate_used is_wide refine_used",
        "test_ekf_iteration.py test_ekf_bending.py test_ekf_wide_prior.py",
    ),
    "fit": ("distance2 misfit", "test_fit.py test_gate.py"),
    "gate": (
        "gate_groups accepted_rows select_rows leave_odd_out joint_nis",
        "test_gate.py test_kf.py",
    ),
    "factor": ("factor solve_factored", "test_factor.py"),
    "sigma": ("move regress innovation_cov", "test_ukf.py"),
    "ukf": ("predict update fuse", "test_ukf.py test_gate.py"),
    "kf": ("update update_shared fuse_row _raise_gain", "test_kf.py test_gate.py"),
    "error_state": (
        "correct _dot _times _sequential doubt_standstill _stands hold _integrate "
        "_slow_transition _add_slow_noise predict_chunk advance",
        "test_error_state_rules.py test_error_state_chunks.py test_error_state.py",
    ),
}
# Changes that change nothing but time, or nothing at all.
EQUIVALENT = {
    ("srukf", "fuse", "left out: continue"),
    ("sigma", "regress", "left out: E[i, n] *= _SHIFT_WEIGHT"),  # is 1
    ("sigma", "regress", "operator swapped: E[i, n] *= _SHIFT_WEIGHT"),
    ("ekf", "_passes", "operator swapped: stop - start"),
    ("error_state", "correct", "left out: posterior = cov"),  # set anew by the first iteration
    *(  # starts lie symmetrically around
        (
            "iteration",
            "refine_used",
            f"operator swapped: start[{a}] += 1.5 * math.sqrt"
            f"(prior_cov[{a}, {a}]) * math.{f}(2.0 * math.pi * k / _STARTS)",
        )
        for a, f in ((0, "cos"), (1, "sin"))
    ),
    ("iteration", "refine_used", "operator swapped: cost - 0.001"),  # the same place again
    ("iteration", "iterate_from", "left out: x, P = (mean.copy(), cov.copy())"),  # likewise
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
    """Line, description and changed copy of every change to a function's body."""
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
            text = ast.unparse(node.test if isinstance(node, ast.If) else node)
            change(target)
            yield node.lineno, f"{what}: {text}", changed


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
        made: dict[str, Callable[..., object]] = {}
        exec(compile(module, "mutant", "exec"), dict(kernel.__globals__), made)
        kernel.__code__ = made[changed.name].__code__
        os._exit(run(tests))
    return os.waitpid(child, 0)[1] != 0


def run(tests: list[str]) -> int:
    """Exit code of the tests, stopped at the first that fails."""
    warnings.simplefilter("ignore")
    quiet = ["-x", "-q", "--no-header", "-p", "no:warnings", "-p", "no:timeout"]
    return int(pytest.main([*quiet, *tests]))


def main(rooms: list[str]) -> int:
    """Print survivors; how many there are."""
    os.chdir(ROOT)
    survivors = total = 0
    for asked in rooms or list(KERNELS):
        room, _, kernel = asked.partition(".")
        names, files = KERNELS[room]
        module = import_module(f"netpos.filters.{room}")
        tests = [
            name.replace("+", " ") if name.startswith("-") else str(TESTS / name)
            for name in files.split()
        ]
        run([*tests, "--collect-only", "-qq"])  # imports what all children need
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        for node in tree.body:
            if not isinstance(node, ast.FunctionDef) or node.name not in (kernel or names).split():
                continue
            known = set(EQUIVALENT)
            if is_noticed(getattr(module, node.name), copy.deepcopy(node), tests):
                raise SystemExit(f"{room}: the tests fail without any change")
            for line, what, changed in mutants(node):
                if (room, node.name, what) in known:  # once: the first of several alike
                    known.remove((room, node.name, what))
                    continue
                total += 1
                if not is_noticed(getattr(module, node.name), changed, tests):
                    survivors += 1
                    print(f"{room}.py:{line} {node.name}: {what}", flush=True)
        print(f"{asked}: {total} changes so far, {survivors} not noticed", flush=True)
    return survivors


if __name__ == "__main__":
    sys.exit(1 if main(sys.argv[1:]) else 0)
