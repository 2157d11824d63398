"""Install wheel and sdist on every available Python, and report the sample with and without Sionna RT.

    python benchmarks/wheels.py [--pythons python3.10 /opt/py/bin/python3.13] [--keep FOLDER]

Both archives are built from this tree. Each Python (those of --pythons, else one of each version from 3.10 to 3.14 that
pyenv, uv or the path has) makes a new environment for each archive, installs it from the package index, copies the
sample and reports it. Sionna RT, Mitsuba and Dr.Jit are then removed, and the same report must give the same levels and
ranks. Prints one line each and exits with 1 when one fails. A minute or two each, the first time with downloads.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MINORS = range(10, 15)
UV = "~/.local/share/uv/python"
RAYS = ("sionna-rt", "mitsuba", "drjit")


def at_hand() -> list[str]:
    """The interpreters 3.10 to 3.14 of this machine that can make environments: pyenv's, uv's, else the path's."""
    roots = f"{os.environ.get('PYENV_ROOT', '~/.pyenv')}/versions", os.environ.get("UV_PYTHON_INSTALL_DIR", UV)
    stored = [folder for root in roots for folder in sorted(Path(root).expanduser().glob("*3.1*/bin"), reverse=True)]
    pythons: dict[int, str] = {}
    for minor, folder in product(MINORS, [*stored, *map(Path, os.get_exec_path())]):
        python = str(folder / f"python3.{minor}")
        # a shim of pyenv answers only for versions that are switched on, a Debian python may lack its ensurepip
        if minor not in pythons and shutil.which(python) and not subprocess.call([python, "-c", "import ensurepip"]):
            pythons[minor] = python
    return list(pythons.values())


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command in a folder outside of this tree. Return its output, or its error if it failed."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=kept, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(
            f"{' '.join(map(str, command[:4]))}: exit {done.returncode}\n{(done.stdout + done.stderr)[-2000:]}"
        )
    return done.stdout


def tried(python: str, archive: Path, folder: Path) -> str:
    """Install an archive and report the sample with and without Sionna RT. Return both results."""
    run(python, "-m", "venv", folder / "env", cwd=folder.parent)
    own = folder / "env" / "bin"
    run(own / "python", "-m", "pip", "install", "--quiet", archive, cwd=folder)
    run(own / "aerpaw-cmp", "sample", "-o", "x", cwd=folder)
    for name in ("audited", "bare"):
        run(own / "aerpaw-cmp", "report", "x/flight.yaml", "-o", name, cwd=folder)
        if name == "audited":
            run(own / "python", "-m", "pip", "uninstall", "--quiet", "--yes", *RAYS, cwd=folder)
    if "Not audited against Sionna RT" not in (folder / "bare" / "report.html").read_text(encoding="utf-8"):
        raise RuntimeError("the page without Sionna RT does not say that nothing was audited")
    for name in ("rss.csv", "rank.csv"):
        if (folder / "audited" / name).read_bytes() != (folder / "bare" / name).read_bytes():
            raise RuntimeError(f"{name} differs without Sionna RT")
    return run(own / "aerpaw-cmp", "--version", cwd=folder).strip() + ": reported, without Sionna RT the same numbers"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--pythons", nargs="+", default=None)
    parser.add_argument("--keep", type=Path, help="leave archives, environments and reports in this new folder")
    args = parser.parse_args()
    temporary = tempfile.TemporaryDirectory()
    folder = args.keep or Path(temporary.name)
    folder.mkdir(exist_ok=True, parents=True)
    run(sys.executable, "-m", "hatchling", "build", "-d", folder / "dist", cwd=ROOT)
    failed = 0
    for python in args.pythons or at_hand():
        for archive in sorted((folder / "dist").iterdir()):
            name = f"{python.replace(os.sep, '_')}-{archive.suffix[1:]}"
            start = time.perf_counter()
            try:
                outcome = tried(python, archive, (folder / name).resolve())
            except (RuntimeError, OSError) as error:
                failed, outcome = 1, f"FAILED {error}"
            print(f"{python} {archive.name}: {outcome} ({time.perf_counter() - start:.0f} s)", flush=True)
            if not args.keep:
                shutil.rmtree(folder / name, ignore_errors=True)
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
