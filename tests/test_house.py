"""No file imports from a floor above its own, and so none in a circle."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_binding_imports_downwards():
    """The floors are the table at the top of its lib.rs."""
    source = ROOT / "crates/ibi-py/src"
    rows = re.findall(r"^//! \| (`.*?) \|", (source / "lib.rs").read_text(encoding="utf-8"), re.MULTILINE)
    floors = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted([*floors, "lib"]) == sorted(path.stem for path in source.glob("*.rs"))
    for name in floors:
        used = set(re.findall(r"\bcrate::(?:\{)?(\w+)", (source / f"{name}.rs").read_text(encoding="utf-8")))
        assert used <= set(floors[: floors.index(name)]), f"{name}.rs imports upwards"


def imported(path, package, modules):
    """Those of our own modules that a module needs before it is there itself."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.rsplit(".", node.level - 1)[0] if node.level else ""
            module = ".".join(part for part in (above, node.module) if part)
            names = [f"{module}.{alias.name}" for alias in node.names]
            yield from (name if name in modules else module for name in names)


def test_no_python_module_imports_itself_by_way_of_others():
    modules = {"ibi_rs._core": (ROOT / "python/ibi_rs/_core.pyi", "ibi_rs")}
    for path in (ROOT / "python/ibi_rs").rglob("*.py"):
        parts = ("ibi_rs", *path.relative_to(ROOT / "python/ibi_rs").with_suffix("").parts)
        package = ".".join(parts[:-1])
        modules[package if parts[-1] == "__init__" else ".".join(parts)] = (path, package)
    graph = {
        name: {other for other in imported(*place, modules) if other in modules and other != name}
        for name, place in modules.items()
    }
    assert len(list(TopologicalSorter(graph).static_order())) == len(modules)


# The house's address --------------------------------------------------------------------------------------


def addresses():
    """Each address of the repository that a published file has, and the path that it leads to."""
    for name in ("README.md", "CITATION.cff", "pyproject.toml", "Cargo.toml"):
        text = (ROOT / name).read_text(encoding="utf-8")
        for base, path in re.findall(
            r"(https://github\.com/[\w-]+/[\w-]+)(?:/(?:blob|tree)/main/([^)\"#\s]+))?", text
        ):
            yield name, base, path
        for owner, path in re.findall(
            r"https://raw\.githubusercontent\.com/([\w-]+/[\w-]+)/main/([^)\s]+)", text
        ):
            yield name, f"https://github.com/{owner}", path


def test_published_files_lead_to_one_repository():
    """What a registry shows has no folder beside it: links are absolute, and what they lead to is here."""
    found = list(addresses())
    assert {name for name, _, _ in found} == {"README.md", "CITATION.cff", "pyproject.toml", "Cargo.toml"}
    assert len({base for _, base, _ in found}) == 1
    for name, _, path in found:
        assert (ROOT / path).exists(), f"{name}: {path} is not there"
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) > 10
    assert [link for link in links if not link.startswith(("https://", "#"))] == []


def test_the_crate_has_the_licences():
    for name in ("LICENSE-MIT", "LICENSE-APACHE"):
        assert (ROOT / "crates/ibi-core" / name).read_bytes() == (ROOT / name).read_bytes()


def test_the_citation_has_the_version():
    (version,) = re.findall(r'(?m)^version = "(.+)"$', (ROOT / "Cargo.toml").read_text(encoding="utf-8"))
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
