"""The house: imports point downwards only, and each layer keeps to its own business."""

from __future__ import annotations

import ast
import functools
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import tooltip_cli

PACKAGE = Path(tooltip_cli.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

# Each layer and the layers below it that it may import; the last three are for everybody.
LAYERS = {
    "cli": {"stages", "report", "sources", "labels", "log", "rig", "method"},
    "stages": {"report", "sources", "labels", "log", "rig", "method"},
    "report": {"labels", "log", "rig", "method"},
    "sources": {"labels", "log", "rig", "method"},
    "labels": {"log", "rig", "method"},
    "log": {"rig", "method"},
    "rig": {"method"},
    "method": set(),
    "errors": set(),
    "resources": set(),
    "machine_code": set(),
}
FREE = {"errors", "resources", "machine_code", ""}
HEAVY = (
    "adlfs",
    "av",
    "botocore",
    "cv2",
    "cyclonedds",
    "dask",
    "distributed",
    "fsspec",
    "gcsfs",
    "matplotlib",
    "numba",
    "numpy",
    "pinocchio",
    "pyarrow",
    "rosbags",
    "s3fs",
    "scipy",
    "skimage",
    "starlette",
    "trimesh",
    "uvicorn",
)


def layer_of(module: Path) -> str:
    return module.relative_to(PACKAGE).parts[0].removesuffix(".py")


def name_of(module: Path) -> str:
    return str(module.relative_to(PACKAGE))


@functools.cache
def nodes_of(module: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(module.read_text(encoding="utf-8"))))


def imports(module: Path) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield (absolute module, names) for every import in a file, however deep."""
    for node in nodes_of(module):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, ()
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            yield node.module or "", tuple(alias.name for alias in node.names)


def inner_imports(module: Path) -> Iterator[str]:
    """Yield the layers of this package that a file imports."""
    for name, names in imports(module):
        head, _, rest = name.partition(".")
        if head != "tooltip_cli":
            continue
        if rest:
            yield rest.split(".")[0]
        else:  # from tooltip_cli import x: a layer, or __version__
            yield from (item if item in LAYERS else "" for item in names)


def attributes(module: Path) -> Iterator[str]:
    """Yield every dotted name that a file uses, e.g. ``np.random.seed``."""
    for node in nodes_of(module):
        if isinstance(node, (ast.Attribute, ast.Name)):
            yield ast.unparse(node)


def calls(module: Path) -> Iterator[str]:
    """Yield the dotted name of everything that a file calls."""
    for node in nodes_of(module):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)


def within(*layers: str) -> list[Path]:
    return [module for module in MODULES if layer_of(module) in layers]


def test_every_module_belongs_to_a_layer() -> None:
    known = {*LAYERS, "__init__"}
    assert {layer_of(module) for module in MODULES} <= known
    assert {layer for layer in LAYERS if within(layer)} == set(LAYERS)


@pytest.mark.parametrize("module", MODULES, ids=name_of)
def test_imports_point_downwards(module: Path) -> None:
    layer = layer_of(module)
    allowed = LAYERS.get(layer, set()) | FREE | {layer}
    upwards = set(inner_imports(module)) - allowed
    assert not upwards, f"{name_of(module)} imports {upwards}"


@pytest.mark.parametrize("module", MODULES, ids=name_of)
def test_only_the_command_line_knows_click(module: Path) -> None:
    heads = {name.split(".")[0] for name, _ in imports(module)}
    assert layer_of(module) == "cli" or "click" not in heads


@pytest.mark.parametrize("module", within("method"), ids=name_of)
def test_the_method_knows_arrays_only(module: Path) -> None:
    heads = {name.split(".")[0] for name, _ in imports(module)}
    outside = {
        "io",
        "json",
        "mcap",
        "os",
        "pathlib",
        "pinocchio",
        "random",
        "shutil",
        "socket",
        "subprocess",
        "tempfile",
        "threading",
        "time",
        "datetime",
        "yaml",
    }
    assert not heads & outside
    assert "open" not in set(calls(module))
    # a generator that a caller seeds is fine, the global state behind np.random.* is not
    drawn = {".".join(name.split(".")[:3]) for name in attributes(module)}
    state = {name for name in drawn if name.startswith("np.random.")}
    assert {name.split("(")[0] for name in state} <= {
        "np.random.Generator",
        "np.random.default_rng",
    }


@pytest.mark.parametrize("module", within("method"), ids=name_of)
def test_the_method_seeds_every_generator(module: Path) -> None:
    for node in nodes_of(module):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.random.default_rng":
            assert node.args, f"{name_of(module)}: a generator without a seed"


@pytest.mark.parametrize("module", [m for m in MODULES if layer_of(m) != "cli"], ids=name_of)
def test_nothing_below_the_command_line_prints_exits_or_installs_handlers(module: Path) -> None:
    forbidden = {"print", "exit", "quit", "sys.exit", "os._exit", "input", "logging.basicConfig"}
    used = set(calls(module))
    assert not used & forbidden
    assert not {name for name in used if name.endswith((".addHandler", ".setLevel"))}
    assert not set(attributes(module)) & {"sys.stdout"}
    writes = {name for name in used if name.startswith(("sys.stderr.write", "sys.stdout.write"))}
    assert not writes


@pytest.mark.parametrize("module", MODULES, ids=name_of)
def test_loggers_are_named_after_their_modules(module: Path) -> None:
    for node in nodes_of(module):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "logging.getLogger":
            assert [ast.unparse(argument) for argument in node.args] == ["__name__"]
    assert not {name for name in calls(module) if name in ("logging.warning", "logging.info")}


@pytest.mark.parametrize("module", MODULES, ids=name_of)
def test_nothing_is_pickled_or_evaluated(module: Path) -> None:
    heads = {name.split(".")[0] for name, _ in imports(module)}
    assert not heads & {"pickle", "marshal", "shelve", "joblib"}
    assert not set(calls(module)) & {"eval", "exec", "yaml.load", "yaml.unsafe_load"}
    loads = [
        ast.unparse(node)
        for node in nodes_of(module)
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle"
    ]
    assert all(text == "allow_pickle=False" for text in loads)


def loaded_by(code: str) -> set[str]:
    """Return the top-level packages that a fresh interpreter has loaded after some code."""
    script = f"import json, sys\n{code}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        cwd=PACKAGE.parent,
    )
    names: list[str] = json.loads(done.stdout.splitlines()[-1])
    return {name.split(".")[0] for name in names}


def test_importing_the_command_line_loads_nothing_heavy() -> None:
    assert not loaded_by("import tooltip_cli.cli.main") & set(HEAVY)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["-h"], []], ids=" ".join)
def test_help_answers_without_loading_anything_heavy(arguments: list[str]) -> None:
    code = (
        "from tooltip_cli.cli.main import main\n"
        "try:\n"
        f"    main({arguments!r})\n"
        "except SystemExit:\n"
        "    pass\n"
    )
    assert not loaded_by(code) & {*HEAVY, "mcap", "yaml"}


@pytest.mark.parametrize("command", ["detect", "estimate", "evaluate", "label", "record", "run"])
def test_help_of_a_command_loads_nothing_heavy(command: str) -> None:
    code = (
        "from tooltip_cli.cli.main import main\n"
        "try:\n"
        f"    main([{command!r}, '--help'])\n"
        "except SystemExit:\n"
        "    pass\n"
    )
    assert not loaded_by(code) & set(HEAVY)
