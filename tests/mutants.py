"""Draw a sample of the library's mutants, test them, and report the share that the tests kill.

    mutmut run 'sb3_options.discovery.ways.x_*_1'                makes the mutants, and times the tests
    python -m tests.mutants test --seed 1 --each 75              tests a sample
    python -m tests.mutants report --seed 1 --each 75            writes docs/results/mutants.json
    python -m tests.mutants show --seed 1 --each 75              what survived, as differences

All mutants are too many: each takes as long as the tests that reach its function. mutmut makes them. They are tested
here because mutmut collects the tests anew for each mutant, and runs them in no order: here every mutant is a process
forked after the collection, and runs the tests of its own module first, then others, the fast ones before the slow.
"""

import argparse
import contextlib
import json
import math
import os
import random
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mutmut.configuration import config
from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.mutation.file_mutation import mutate_file_contents
from mutmut.mutation.trampoline import set_mutant_under_test
from mutmut.utils.format_utils import get_mutant_name, mangled_name_from_mutant_name

FOLDERS = ("learning", "execution", "options", "discovery")
"""Folders of the library; each gives the sample as many mutants as the others."""

RESULTS = Path("docs/results/mutants.json")
MADE = Path("mutants")  # where mutmut writes the mutated copy of the library, and which tests reach a function
ENOUGH = 30.0  # seconds of tests a mutant meets at most; one that needs more to die counts as a survivor

TIMES, PLUS = 4.0, 15.0
"""A test that takes this many times as long as without a mutant, and this many seconds more, has timed out."""

Z = 1.959964  # of a 95 % interval


def population() -> dict[str, list[str]]:
    """The names of all mutants of each folder, in a fixed order."""
    return {
        folder: [
            get_mutant_name(path, name)
            for path in sorted(Path("sb3_options", folder).rglob("*.py"))
            for name in mutate_file_contents(str(path), path.read_text("utf-8")).mutant_names
        ]
        for folder in FOLDERS
    }


def draw(names: dict[str, list[str]], seed: int, each: int) -> dict[str, list[str]]:
    """``each`` mutants of every folder, drawn without replacement; one seed, one sample."""
    generator = random.Random(seed)
    return {folder: sorted(generator.sample(all_of_it, each)) for folder, all_of_it in names.items()}


class Forks:
    """A plugin of pytest that collects the tests once and then tests every mutant in a process of its own."""

    def __init__(self, names: list[str], results: Path) -> None:
        self.names, self.results = names, results
        times = json.loads(Path("mutmut-stats.json").read_text("utf-8"))
        self.reached, self.seconds = times["tests_by_mangled_function_name"], times["duration_by_test"]
        self.found: dict[str, str] = json.loads(results.read_text("utf-8")) if results.exists() else {}

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Instead of running the tests."""
        items = {item.nodeid: item for item in session.items}
        for number, name in enumerate(self.names):
            if name in self.found:
                continue
            began, tests = time.monotonic(), self._tests_of(name, items)
            self.found[name] = self._tested(session, name, [items[test] for test in tests]) if tests else "no tests"
            self.results.write_text(json.dumps(self.found), "utf-8")
            print(
                f"{number + 1}/{len(self.names)} {self.found[name]} {time.monotonic() - began:.1f} s {name}", flush=True
            )
        return True

    def _tests_of(self, name: str, items: dict[str, pytest.Item]) -> list[str]:
        _, folder, *_, module, _ = name.split(".")
        own = f"tests/{folder}/test_{module}"
        reached = [test for test in self.reached.get(mangled_name_from_mutant_name(name), []) if test in items]
        reached.sort(key=lambda test: (not test.startswith(own), self.seconds[test], test))
        chosen: list[str] = []
        total = 0.0
        for test in reached:
            total += self.seconds[test]
            if total <= ENOUGH or not chosen:
                chosen.append(test)
        return chosen

    def _tested(self, session: pytest.Session, name: str, items: list[pytest.Item]) -> str:
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            os.setpgrp()
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            set_mutant_under_test(name)
            try:
                for item, following in zip(items, [*items[1:], None], strict=True):
                    signal.alarm(math.ceil(TIMES * self.seconds[item.nodeid] + PLUS))
                    item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                    if session.testsfailed:
                        os._exit(1)
                os._exit(0)
            except BaseException:
                os._exit(1)
        _, status = os.waitpid(child, 0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what it may have started itself
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGALRM:
            return "timed out"
        return "killed" if status else "survived"


def test(names: list[str], results: Path) -> int:
    """Test mutants, but for those of which ``results`` tells already; the exit code of pytest."""
    results, selection = results.resolve(), config().pytest_add_cli_args_test_selection
    arguments = config().pytest_add_cli_args
    os.chdir(MADE)
    sys.path[:] = [str(Path.cwd()), *(entry for entry in sys.path if entry not in ("", str(Path.cwd().parent)))]
    sys.modules.pop("tests", None)  # those of the copy are meant
    set_mutant_under_test("none")
    return int(pytest.main(["--rootdir=.", "-q", "-s", *arguments, *selection], plugins=[Forks(names, results)]))


def stratified(folders: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The share of all mutants that die, each folder weighed by its mutants, with a 95 % interval (normal)."""
    total = sum(f["mutants"] for f in folders.values())
    shares = [(f["mutants"] / total, f["share"], f["drawn"] - f["equivalent"]) for f in folders.values()]
    share = sum(weight * p for weight, p, _ in shares)
    half = Z * math.sqrt(sum(weight**2 * p * (1 - p) / n for weight, p, n in shares))
    return {"share": round(share, 3), "low": round(share - half, 3), "high": round(min(share + half, 1.0), 3)}


def report(names: dict[str, list[str]], found: dict[str, str], label: str) -> None:
    """Write what became of a sample to `RESULTS`, beside earlier ones; names there say which are equivalent."""
    from sb3_options.runs.intervals import share_interval  # here: `test` imports the mutated copy of the library

    results = json.loads(RESULTS.read_text("utf-8"))
    folders, survivors = {}, []
    for folder in FOLDERS:
        sample = [name for name in found if name.split(".")[1] == folder]
        counts = Counter(found[name] for name in sample)
        alive = [name for name in sample if found[name] in ("survived", "no tests")]
        equivalent = [name for name in alive if name in results["equivalent"]]
        survivors += sorted(set(alive) - set(equivalent))
        died, tried = counts["killed"] + counts["timed out"], len(sample) - len(equivalent)
        share, low, high = share_interval(died, tried)
        folders[folder] = {
            "mutants": len(names[folder]),
            "drawn": len(sample),
            "killed": counts["killed"],
            "timed out": counts["timed out"],
            "survived": tried - died,
            "equivalent": len(equivalent),
            "share": round(share, 3),
            "low": round(low, 3),
            "high": round(high, 3),
        }
    results["samples"][label] = {"folders": folders, "all": stratified(folders), "survivors": survivors}
    RESULTS.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", "utf-8")
    print(json.dumps(results["samples"][label], indent=1, ensure_ascii=False))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["test", "report", "show"])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--each", type=int, required=True, help="mutants of each folder")
    parser.add_argument("--label", help="of the sample in the results; by default its seed")
    arguments = parser.parse_args()
    names = population()
    in_turn = [
        n for of_each in zip(*draw(names, arguments.seed, arguments.each).values(), strict=True) for n in of_each
    ]
    results = MADE / f"sample-{arguments.seed}-{arguments.each}.json"
    if arguments.action == "test":
        sys.exit(test(in_turn, results))
    found = json.loads(results.read_text("utf-8"))
    if arguments.action == "report":
        report(names, found, arguments.label or f"seed {arguments.seed}")
        return
    for name in in_turn:
        if found.get(name) in ("survived", "no tests"):
            path = Path(*name.split(".")[:-1]).with_suffix(".py")
            print(f"{found[name]}: {name}", *get_diff_for_mutant(name, path=path).splitlines()[2:], sep="\n")


if __name__ == "__main__":
    main()
