"""What holds for the tree as a whole."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted((ROOT / "src").rglob("*.py"))


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


def test_import_is_light():
    code = "import sys, rfpose; print(*[m for m in ('numpy', 'numba', 'h5py', 'PySide6') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_numba_stays_behind_its_door(path):
    text = path.read_text()
    if path.name == "jit.py":
        return
    assert not re.search(r"@(numba\.)?(njit|jit)\b", text), "use the decorators of rfpose.jit"
    if path.name != "_kernels.py":
        assert not re.search(r"^\s*@kernel", text, re.M), "kernels live in _kernels.py"
    else:
        assert not re.search(r"^\s*raise\b|\bopen\(|np\.random", text, re.M), "a kernel does not raise, read or draw"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_only_the_command_line_prints(path):
    if "cli" not in path.parts:
        assert not re.search(r"^\s*print\(", path.read_text(), re.M)


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if p.name == "_kernels.py"], ids=lambda p: str(p.relative_to(ROOT / "src"))
)
def test_reordered_sums_are_not_called_from_kernels(path):
    """A callee is compiled on its own and again inside its caller; where sums may be reordered the two differ.

    Which of them runs depends on whether the caller came from the cache, so that equal runs would give unequal bytes.
    Inline such a piece (`kernel_inline`) or call it from Python only.
    """
    functions = [node for node in parsed(path).body if isinstance(node, ast.FunctionDef)]
    decorators = {f.name: {d.id for d in f.decorator_list if isinstance(d, ast.Name)} for f in functions}
    fast = {name for name, names in decorators.items() if names & {"kernel_fast", "kernel_parallel_fast"}}
    for function in functions:
        called = {n.func.id for n in ast.walk(function) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}
        assert not called & fast, f"{function.name} calls {called & fast}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_private_names_stay_in_their_module(path):
    """A name that begins with an underscore is its module's own, a module of such a name its package's own.

    Kernels are compiled together, so that a ``_kernels`` module may call another one's.
    """
    source = ROOT / "src"
    here = path.relative_to(source).parts
    for node in ast.walk(parsed(path)):
        if not (isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rfpose")):
            continue
        parts = tuple(node.module.split("."))
        for name in (alias.name for alias in node.names):
            private = name.startswith("_") and not name.startswith("__")
            is_module = (source.joinpath(*parts) / f"{name}.py").exists()
            assert not private or is_module, f"{node.module}.{name} is that module's own"
            whole = (*parts, name) if is_module else parts
            for depth, part in enumerate(whole):
                if part.startswith("_") and not (part == "_kernels" and here[-1] == "_kernels.py"):
                    assert here[:depth] == whole[:depth], f"{'.'.join(whole)} is the package's own"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_functions_have_few_parameters(path):
    """What belongs together is a record; a command's options become one by `rfpose.cli._support.gathered`.

    Kernels take arrays side by side, since numba knows no records of records.
    """
    if path.name == "_kernels.py":
        return
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            count = len([*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs])
            assert count <= 12, f"line {node.lineno}: {count} parameters"


MEANINGLESS = {
    "Data",
    "Found",
    "Item",
    "Mirrors",
    "Plan",
    "Problem",
    "Scene",
    "Stages",
    "State",
    "Told",
    "Workshop",
    "World",
}


def test_a_class_name_means_one_thing():
    where = {}
    for path in SOURCES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where.setdefault(node.name, []).append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: places for name, places in where.items() if len(places) > 1} == {}
    assert not MEANINGLESS & set(where), "say what is found, told or planned"


def _imports(path):
    """Yield (module, name) of what a script, or a page's code, imports of rfpose."""
    blocks = [path.read_text()]
    if path.suffix == ".md":
        blocks = re.findall(r"^```python\n(.*?)^```", blocks[0], re.M | re.S)
    for block in blocks:
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "rfpose":
                yield from ((node.module, alias.name) for alias in node.names)


OUTSIDE = [
    ROOT / "README.md",
    *(p for d in ("benchmarks", "scripts", "docs") for p in sorted((ROOT / d).rglob("*.[mp][dy]"))),
]


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda p: str(p.relative_to(ROOT)))
def test_what_is_imported_beside_the_package_is_there(path):
    """Types are checked in the package only: a name that changed there may live on in a page or a benchmark."""
    for module, name in _imports(path):
        file = ROOT.joinpath("src", *module.split("."))
        text = (file / "__init__.py" if file.is_dir() else file.with_suffix(".py")).read_text()
        is_module = (file / name).is_dir() or (file / f"{name}.py").exists()
        assert is_module or re.search(rf"\b{name}\b", text), f"{module} has no {name}"
