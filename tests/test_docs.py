"""What the documentation shows runs and prints what it says; what is public is documented."""

import contextlib
import dataclasses
import doctest
import importlib
import inspect
import io
import json
import pkgutil
import re
from pathlib import Path

import ibi_rs as ibi
import pytest

ROOT = Path(__file__).parents[1]
MODULES = [
    "ibi_rs",
    *(
        module.name
        for module in pkgutil.walk_packages(ibi.__path__, "ibi_rs.")
        if not module.name.endswith(("._core", ".__main__"))
    ),
]


# Docstrings ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_print_what_they_say(name):
    module = importlib.import_module(name)
    assert inspect.getdoc(module), f"{name} has no docstring"
    report = io.StringIO()
    runner = doctest.DocTestRunner()
    for test in doctest.DocTestFinder().find(module, name):
        runner.run(test, out=report.write)
    assert runner.summarize(verbose=False).failed == 0, report.getvalue()


def public():
    """What the seven namespaces export, each with its name."""
    for module in (ibi, ibi.datasets, ibi.features, ibi.metrics, ibi.ros, ibi.stages, ibi.synth, ibi.viz):
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isfunction(thing) or inspect.isclass(thing):
                yield f"{module.__name__}.{name}", thing


PUBLIC = dict(public())
FUNCTIONS = {name: thing for name, thing in PUBLIC.items() if inspect.isfunction(thing)}
RECORDS = {name: thing for name, thing in PUBLIC.items() if dataclasses.is_dataclass(thing)}
METHODS = {
    f"{name}.{method}": getattr(value, "fget", None) or getattr(value, "__func__", value)
    for name, thing in PUBLIC.items()
    if inspect.isclass(thing)
    for method, value in vars(thing).items()
    if not method.startswith("_") and (callable(value) or isinstance(value, (property, classmethod)))
}


def section(doc, title):
    """The body of one numpydoc section; empty if there is none."""
    found = re.search(rf"^{title}\n-+\n(.*?)(?=^\w[\w ]*\n---|\Z)", doc, re.MULTILINE | re.DOTALL)
    return found[1] if found else ""


def entries(doc, *titles):
    """The names that a section of parameters or attributes explains."""
    heads = re.findall(
        r"^(\w+(?:, \w+)*)(?: : .*)?$", "\n".join(section(doc, t) for t in titles), re.MULTILINE
    )
    return {name for head in heads for name in head.split(", ")}


@pytest.mark.parametrize("name", [*PUBLIC, *METHODS])
def test_everything_public_says_what_it_is(name):
    thing = PUBLIC.get(name) or METHODS[name]
    doc = thing.__doc__  # not getdoc, which would find that of a base class
    assert doc, f"{name} has no docstring"
    assert not doc.startswith(f"{name.rpartition('.')[2]}("), f"{name} has the docstring a dataclass makes up"
    summary = inspect.cleandoc(doc).partition("\n\n")[0]
    assert summary.endswith((".", ").")), f"{name}: {summary}"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_and_exception_is_explained(name):
    function = FUNCTIONS[name]
    doc = inspect.getdoc(function)
    arguments = set(inspect.signature(function).parameters)
    assert arguments - entries(doc, "Parameters") == set()
    assert section(doc, "Returns"), f"{name} does not say what it returns"
    if re.search(r"^\s+raise \w", inspect.getsource(function), re.MULTILINE):
        assert section(doc, "Raises"), f"{name} raises and does not say what"


@pytest.mark.parametrize("name", RECORDS)
def test_every_field_is_explained(name):
    fields = {field.name for field in dataclasses.fields(RECORDS[name])}
    assert fields - entries(inspect.getdoc(RECORDS[name]), "Parameters", "Attributes") == set()


def test_the_attributes_of_a_registration_are_explained():
    held = {"labels", "rounds", "stop_reason", "timings", "resolution", "params", "warnings"}
    assert entries(inspect.getdoc(ibi.Registration), "Attributes") >= held


# Pages ---------------------------------------------------------------------------------------------------

# A block of Python, and the block of text that follows it with nothing but blank lines between.
BLOCK = re.compile(r"^```python\n(.*?)^```$(?:\s*^```text\n(.*?)^```$)?", re.MULTILINE | re.DOTALL)
SECONDS = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?(?= s\b)")  # differ from run to run


def blocks(text):
    """The code of each block, its first line's number, and what it must print (None: anything)."""
    return [(m[1], text.count("\n", 0, m.start(1)) + 1, m[2]) for m in BLOCK.finditer(text)]


def run_blocks(text, name):
    """Run the blocks of a page one after the other, as a reader would who types them in."""
    namespace = {"__name__": "page"}
    for code, line, expected in blocks(text):
        printed = io.StringIO()
        source = "\n" * (line - 1) + code  # so that a traceback names the line of the page
        with contextlib.redirect_stdout(printed):
            exec(compile(source, name, "exec"), namespace)
        if expected is not None:
            shown, wanted = (SECONDS.sub("?", output).strip() for output in (printed.getvalue(), expected))
            assert shown == wanted, f"{name}, line {line}: the code prints something else"


@pytest.fixture
def beside_examples(tmp_path, monkeypatch):
    """A directory of its own with the repository's examples in it, and no window that opens."""
    (tmp_path / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return tmp_path


@pytest.mark.parametrize(
    "name",
    ["README.md", "docs/stages.md", "docs/batch.md", "docs/datasets.md", "docs/picking.md", "docs/own.md"],
)
def test_a_page_runs(name, beside_examples):
    text = (ROOT / name).read_text(encoding="utf-8")
    assert blocks(text), f"{name} shows no Python"
    run_blocks(text, name)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "docs/notebooks").glob("*.ipynb")), ids=lambda path: path.stem
)
def test_a_notebook_runs_and_holds_no_output(path, monkeypatch):
    cells = [
        cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"
    ]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    monkeypatch.chdir(path.parent)
    lines = "".join("".join(cell["source"]) + "\n" for cell in cells).splitlines()
    code = "\n".join("" if line.startswith("%") else line for line in lines)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, path.name, "exec"), {"__name__": "notebook"})
    wanted = {"bin": "0 0.59 mm of 4.1: right", "own_matches": "12 right of 12"}[path.stem]
    assert re.sub(r"[\d.]+ mm", "? mm", wanted) in re.sub(r"[\d.]+ mm", "? mm", printed.getvalue())
    assert "none of the nine" not in printed.getvalue()


PAGE = """\
# Page

```python
x = 3
```

Words between.

```python
print(f"found {x} in {x / 100:.3f} s")
```

```text
found 3 in 0.002 s
```

```sh
rm -r everything
```

```python
print("unchecked")
```

A line between.

```text
something else
```
"""


def test_a_page_is_cut_into_its_blocks():
    printing = 'print(f"found {x} in {x / 100:.3f} s")\n'
    first, second, third = blocks(PAGE)
    assert first == ("x = 3\n", 4, None)
    assert second == (printing, 10, "found 3 in 0.002 s\n")
    assert third[2] is None
    run_blocks(PAGE, "PAGE")


def test_a_page_that_shows_something_else_fails():
    with pytest.raises(AssertionError, match="PAGE, line 10: the code prints something else"):
        run_blocks(PAGE.replace("found 3 in", "found 4 in"), "PAGE")
    with pytest.raises(NameError):
        run_blocks(PAGE.replace("x = 3", "y = 3"), "PAGE")
