"""How large and how simple the code is: one JSON line per figure, for this checkout or another one.

    python benchmarks/house.py [--root DIR]

`followed` counts the modules of this package that a newcomer opens to follow `wearcap capture pipeline=X` from the verb
to the motion: the verb, and what it reaches by imports within cli/, evaluation/, runtime/ and the system's folder.
"""

import argparse
import ast
import json
import re
import statistics
from collections import Counter
from pathlib import Path

SYSTEMS = ("hps", "ireplica", "hmd2", "mocap_every", "echo")
MANY_ARGUMENTS = 10


def functions(tree: ast.AST) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def public_names(tree: ast.Module) -> list[str]:
    """Top-level functions and classes that do not begin with an underscore."""
    defined = [node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    return [name for name in defined if not name.startswith("_")]


def called_once(trees: dict[Path, ast.Module]) -> tuple[int, int]:
    """Private functions and methods whose name is used once in the whole package beside its definitions; and all."""
    used: Counter[str] = Counter()
    for tree in trees.values():
        used.update(node.id for node in ast.walk(tree) if isinstance(node, ast.Name))
        used.update(node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute))
    names = [function.name for tree in trees.values() for function in functions(tree)]
    private = [name for name in names if name.startswith("_") and not name.startswith("__")]
    return sum(used[name] == 1 for name in private), len(private)


def wide_constructors(trees: dict[Path, ast.Module]) -> list[str]:
    """Classes whose constructor, or whose dataclass fields, are more than `MANY_ARGUMENTS`."""
    found = []
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.ClassDef):
                continue
            made = next((f for f in node.body if isinstance(f, ast.FunctionDef) and f.name == "__init__"), None)
            annotated = [part for part in node.body if isinstance(part, ast.AnnAssign)]
            fields = [part for part in annotated if "ClassVar" not in ast.unparse(part.annotation)]
            dataclass = any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)
            count = len(made.args.args) + len(made.args.kwonlyargs) - 1 if made else len(fields) if dataclass else 0
            if count > MANY_ARGUMENTS:
                found.append(f"{path.stem}.{node.name}")
    return found


def followed(source: Path, trees: dict[Path, ast.Module], system: str) -> int:
    """Modules from the verb `capture` to the system's pipeline and all that this reaches in its own folder."""
    rooms = ("cli", "evaluation", "runtime", f"systems/{system}")
    by_name = {".".join(("wearcap", *path.relative_to(source).with_suffix("").parts)): path for path in trees}
    rest = [source / "cli" / "capture.py", source / "systems" / system / "pipeline.py"]
    reached: set[Path] = set()
    while rest:
        path = rest.pop()
        if path in reached or path not in trees:
            continue
        reached.add(path)
        for node in ast.walk(trees[path]):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            there = [by_name[name] for name in names if name in by_name]
            rest += [p for p in there if p.relative_to(source).as_posix().startswith(rooms)]
    return len(reached)


def lines_of(folder: Path, pattern: str = "*.py") -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob(pattern))


def words_of(root: Path) -> int:
    """Words of README and of all pages of docs/."""
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    return sum(len(page.read_text(encoding="utf-8").split()) for page in pages)


def figures(root: Path) -> dict[str, object]:
    source, houses = root / "src" / "wearcap", (root / "src", root / "data_prep")
    texts = {path: path.read_text(encoding="utf-8") for house in houses for path in sorted(house.rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    of_product = {path: tree for path, tree in trees.items() if path.is_relative_to(source)}
    once, every = called_once(of_product)
    lengths = [(f.end_lineno or 0) - f.lineno + 1 for tree in trees.values() for f in functions(tree)]
    code = [line for text in texts.values() for line in text.splitlines() if line.strip()]
    return {
        "wearcap_lines": lines_of(source),
        "wearsim_lines": lines_of(root / "src" / "wearsim"),
        "data_prep_lines": lines_of(root / "data_prep"),
        "lines": sum(len(text.splitlines()) for text in texts.values()),
        "files": len(texts),
        "benchmark_lines": lines_of(root / "benchmarks"),
        "test_lines": lines_of(root / "tests"),
        "yaml_files": sum(1 for _ in (root / "conf").rglob("*.yaml")),
        "doc_words": words_of(root),
        "median_function_lines": statistics.median(lengths),
        "characters_a_line": round(statistics.mean(map(len, code)), 1),
        "fmt_skip": sum(len(re.findall(r"# fmt: skip", text)) for text in texts.values()),
        "private_functions_called_once": round(once / every, 3),
        "public_names": sum(len(public_names(tree)) for tree in trees.values()),
        "wide_constructors": wide_constructors(of_product),
        "followed": {
            system: followed(source, of_product, system) for system in SYSTEMS if (source / "systems" / system).is_dir()
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[1], help="a checkout")
    for name, value in figures(parser.parse_args().root).items():
        print(json.dumps({"name": name, "value": value}))


if __name__ == "__main__":
    main()
