"""The LLVM that Dr.Jit uses to compile: find it, try it in a child process, or return the command that installs it.

This module uses only the standard library, so that set-up can use it before other packages work.

Each version is tried before it is used. Dr.Jit 1.5 refuses LLVM 14 and loads LLVM 15 and 16, but on machines with
AVX-512 these two abort the process in the first solver call ("Cannot select: fmaximum"). An abort cannot be caught. The
trial therefore runs in a child process with an empty kernel cache, because a cached kernel would hide the fault.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

from ..common.errors import UsageError
from ..common.files import cache_folder
from ..common.versions import version

# Smallest major version of LLVM: Dr.Jit refuses LLVM 14, and LLVM 15 and 16 abort on AVX-512. LLVM 19 and 22 were
# tested on a machine with AVX-512.
MINIMUM_MAJOR = 17

# Variable that Dr.Jit reads. A path that the user has set is tried and never replaced.
LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"

# Variable with the folders that are searched instead of those of the system, separated as in PATH.
FOLDERS_VARIABLE = "AERPAW_CMP_LLVM_FOLDERS"

# Time limit of a trial [s]. A trial takes about two seconds. The limit is far longer, so that a slow disk is not
# mistaken for a library that hangs.
_TRIAL_TIMEOUT_S = 300.0

# The wheel of Dr.Jit needs libatomic.so.1, which a minimal Debian does not contain.
APT_RUNTIME = "libatomic1"

_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm*/lib",
    "/usr/lib/llvm*/lib64",
    "/usr/local/lib",
    "/usr/local/opt/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    f"{sys.prefix}/lib",
)

_NAME = re.compile(r"libLLVM(?:-(?P<dash>\d+(?:\.\d+)*))?\.(?:so|dylib)(?:\.(?P<dot>\d+(?:\.\d+)*))?")

# A program that traces a direct and a reflected path of known length over one ground triangle. The program uses the
# same kinds of instructions as Sionna's solver, so it aborts in the same way with LLVM 15 on AVX-512. Loading Sionna
# itself would take 2 s.
TRIAL_PROGRAM = """
import json, math, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except (ImportError, ValueError, OSError):
    pass
import drjit as dr, mitsuba as mi
mi.set_variant(sys.argv[1])
mesh = mi.Mesh("ground", vertex_count=3, face_count=1)
buffers = mi.traverse(mesh)
buffers["vertex_positions"] = mi.Float([-500.0, -500.0, 0.0, 500.0, -500.0, 0.0, 0.0, 800.0, 0.0])
buffers["faces"] = mi.UInt32([0, 1, 2])
buffers.update()
scene = mi.load_dict({"type": "scene", "ground": mesh})
tower, uav = mi.Point3f(0.0, 0.0, 10.0), mi.Point3f(30.0, 0.0, 20.0)
dr.make_opaque(tower, uav)
direct = dr.norm(uav - tower)
hidden = scene.ray_test(mi.Ray3f(tower, dr.normalize(uav - tower), direct, 0.0, []))
hit = scene.ray_intersect(mi.Ray3f(tower, dr.normalize(mi.Point3f(uav.x, uav.y, -uav.z) - tower)))
lost = scene.ray_test(hit.spawn_ray_to(uav)) | ~hit.is_valid() | (hit.bsdf().flags() == 0)
start = (mi.UInt32(0), mi.UInt64(dr.round(dr.minimum(hit.t, 1e3))))
key = dr.while_loop(start, lambda k, h: k < 3, lambda k, h: (k + 1, (h ^ mi.UInt64(k)) * 1099511628211))[1]
lost |= dr.scatter_inc(dr.zeros(mi.UInt32, 8), mi.UInt32(key % 8), ~lost) != 0
lengths = [dr.select(hidden, 0, direct), dr.select(lost, 0, dr.maximum(hit.t, 1e-3) + dr.norm(uav - hit.p))]
dr.eval(lengths)
found = [float(length[0]) for length in lengths]
right = all(abs(a - math.hypot(30.0, b)) < 1e-3 for a, b in zip(found, (10.0, 30.0)))
llvm = list(dr.detail.llvm_version()) if "llvm" in sys.argv[1] else []
print(json.dumps({"right": right, "found_m": found, "llvm": llvm}))
"""

# The program for ``doctor`` and ``make setup``. This program also detects a Sionna RT that cannot be loaded.
_SIONNA_LOADS = f"""{TRIAL_PROGRAM}
import typing, typing_extensions
typing.__dict__.setdefault("Self", typing_extensions.Self)
import sionna.rt
"""


@dataclass(frozen=True, slots=True)
class Library:
    """A libLLVM file. ``version`` is empty if its name does not contain a version."""

    path: Path
    version: tuple[int, ...]

    @property
    def label(self) -> str:
        """Version and path, such as ``LLVM 19.1 (/usr/lib/...)``."""
        return f"LLVM {'.'.join(map(str, self.version)) or '?'} ({self.path})"


@dataclass(frozen=True, slots=True)
class Trial:
    """The result of trying one library, or one GPU variant (``library`` is None), in a child process.

    ``reason`` is empty if ``ok``. ``blames_library`` is False if the trial could not start. ``missing`` then names the
    shared library that Dr.Jit could not load, if that was the cause.
    """

    library: Library | None
    ok: bool
    reason: str = ""
    blames_library: bool = True
    missing: str = ""


def version_in_name(name: str) -> tuple[int, ...] | None:
    """Return the version in a libLLVM file name: empty if the name has no version, None if the file is not a libLLVM.

    >>> version_in_name("libLLVM.so.19.1"), version_in_name("libLLVM-15.so.1"), version_in_name("libLLVM.so")
    ((19, 1), (15,), ())
    >>> version_in_name("libLLVM-C.so") is None
    True
    """
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    digits = match["dash"] or match["dot"] or ""
    return tuple(int(part) for part in digits.split(".") if part)


def _library(path: Path) -> Library | None:
    """Return the file behind a name. Links are followed because ``libLLVM.so`` often points to ``libLLVM.so.19.1``."""
    # a broken link may remain after a package was removed
    if path.suffix == ".a" or not path.is_file():  # a development package contains 200 static libraries
        return None
    versions = [version_in_name(name) for name in (path.resolve().name, path.name)]
    if versions == [None, None]:
        return None
    # prefer the name with the release, because the number in 'libLLVM.so.1' is the revision of an interface
    return Library(path.resolve(), max((version for version in versions if version), default=()))


def _system_paths() -> list[Path]:
    """Return every file with a libLLVM name that is known to the linker or is in one of the usual folders."""
    paths: list[Path] = []
    # on Debian, /sbin is not in the path of an ordinary user
    if ldconfig := shutil.which("ldconfig") or shutil.which("/sbin/ldconfig"):
        listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
        paths += [Path(line.rpartition("=> ")[2]) for line in listing.splitlines() if "libLLVM" in line]
    for pattern in _FOLDERS:
        folder = Path(pattern)
        # pathlib refuses absolute patterns, so search from the root
        paths += folder.parents[-1].glob(str(folder.relative_to(folder.anchor) / "libLLVM*"))
    return paths


class SionnaMissingError(UsageError):
    """The error if Sionna RT cannot be loaded. Only the audit and ``rt.engine: sionna`` need it."""


def candidates(environ: Mapping[str, str] = os.environ) -> list[Library]:
    """Return the libLLVM files in the order of trials: newest first, unknown versions last.

    If ``DRJIT_LIBLLVM_PATH`` is set, only that file is returned.

    Raises
    ------
    SionnaMissingError
        If the file in ``DRJIT_LIBLLVM_PATH`` does not exist.
    """
    if chosen := environ.get(LIBRARY_VARIABLE):
        path = Path(chosen)
        if not path.is_file():
            found = f"{LIBRARY_VARIABLE} names {chosen}, which is not the file of a libLLVM"
            raise SionnaMissingError(f"{found}. Repair it with: unset {LIBRARY_VARIABLE}")
        return [_library(path) or Library(path.resolve(), ())]
    if folders := environ.get(FOLDERS_VARIABLE):
        paths = [path for folder in folders.split(os.pathsep) for path in Path(folder).glob("libLLVM*")]
    else:
        paths = _system_paths()
    by_path: dict[Path, Library] = {}
    # if one file has several names, keep the name with the release
    for library in filter(None, map(_library, paths)):
        by_path[library.path] = max(by_path.get(library.path, library), library, key=lambda file: file.version)
    # an empty version sorts below every number, so unknown files come last
    return sorted(by_path.values(), key=lambda library: (library.version, str(library.path)), reverse=True)


def _too_old(version: Sequence[int]) -> str:
    if version and version[0] < MINIMUM_MAJOR:
        return f"LLVM {version[0]} is too old; {MINIMUM_MAJOR} or newer is needed"
    return ""


def _missing_library(text: str) -> str:
    match = re.search(r"(lib\S+\.so[.\d]*)(?:: cannot open shared object file|$)", text, flags=re.MULTILINE)
    return match[1] if match else ""


def _failure(child: subprocess.CompletedProcess[str]) -> str:
    """Return in one line why a child failed: the signal that ended it and its last message."""
    if missing := _missing_library(child.stderr):
        return f"Dr.Jit cannot be loaded, because the system has no {missing}"
    lines = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    message = next((line for line in lines if "LLVM ERROR" in line), lines[-1] if lines else "no message")
    # a negative code is the number of a signal, as when LLVM aborts
    how = f"was ended by signal {-child.returncode}" if child.returncode < 0 else f"ended with {child.returncode}"
    return f"the trial {how}: {message[:200]}"


def _run_trial(library: Library | None, variant: str, program: str, timeout_s: float) -> tuple[str, dict[str, object]]:
    """Return the reason of a failure (empty if there is none) and the answer of the child."""
    with tempfile.TemporaryDirectory(prefix="aerpaw-cmp-trial-") as scratch:
        # use an empty cache: a kernel in the user's cache would hide that this library cannot compile
        environ = {**os.environ, "DRJIT_CACHE_DIR": scratch}
        if library is not None:
            environ[LIBRARY_VARIABLE] = str(library.path)
        try:
            child = subprocess.run(
                [sys.executable, "-c", program, variant],
                # Python puts the working folder first in its path, so a file mitsuba.py there would be run
                cwd=scratch,
                env=environ,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                # LLVM's messages may contain any bytes
                errors="replace",
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"the trial did not end within {timeout_s:g} s", {}
    if child.returncode:
        return _failure(child), {}
    try:
        answer = dict(json.loads(child.stdout.splitlines()[-1]))
    except (ValueError, IndexError, TypeError):
        return f"the trial's answer is unreadable: {child.stdout[-200:]!r}", {}
    if not answer.get("right"):
        return f"the trial's path lengths are wrong: {answer.get('found_m')}", answer
    return "", answer


def try_library(library: Library, *, program: str = _SIONNA_LOADS, timeout_s: float = _TRIAL_TIMEOUT_S) -> Trial:
    """Trace two paths with this library in a child process (about 2 s with Sionna).

    An error or a crash of the child becomes a failed trial.

    Parameters
    ----------
    library : Library
    program : str
        Program that the child runs. The program prints one JSON line.
    timeout_s : float
        Time after which the child is ended and the trial counts as failed [s].

    Returns
    -------
    Trial
        Result of the trial.
    """
    if reason := _too_old(library.version):
        return Trial(library, False, reason)
    reason, answer = _run_trial(library, "llvm_ad_mono_polarized", program, timeout_s)
    version = answer.get("llvm")
    if isinstance(version, list) and version:
        library = Library(library.path, tuple(int(part) for part in version))
    return _verdict(library, reason or _too_old(library.version))


def try_variant(variant: str) -> Trial:
    """Trace two paths with another Mitsuba variant (``cuda_ad_mono_polarized``) in a child process."""
    return _verdict(None, _run_trial(None, variant, TRIAL_PROGRAM, _TRIAL_TIMEOUT_S)[0])


def _verdict(library: Library | None, reason: str) -> Trial:
    missing = _missing_library(reason) if reason.startswith("Dr.Jit cannot be loaded") else ""
    # Dr.Jit reports a library that it cannot load as an ImportError, too
    blameless = missing or (re.search("ModuleNotFoundError|ImportError", reason) and "LLVM" not in reason)
    return Trial(library, not reason, reason, not blameless, missing)


def first_that_works(libraries: Iterable[Library], attempt: Callable[[Library], Trial] | None = None) -> list[Trial]:
    """Try libraries in order (default: :func:`try_library`) until one works. Return all trials, in order."""
    attempt = attempt or try_library
    trials: list[Trial] = []
    for library in libraries:
        trials.append(attempt(library))
        # stop if the library is not the cause (for example, sionna is not installed): another LLVM would fail in the
        # same way
        if trials[-1].ok or not trials[-1].blames_library:
            break
    return trials


def _verdict_file(library: Library) -> Path:
    """Return the file that stores a successful trial for this library file, these versions and this processor."""
    try:
        processor = next(
            (line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Features"))),
            platform.processor(),
        )
    except OSError:
        processor = platform.processor()
    stat = library.path.stat()
    versions = [version(name) for name in ("sionna-rt", "mitsuba", "drjit")]
    # include the processor in the key, because the nodes of a cluster share home folders
    key = repr((str(library.path), stat.st_size, stat.st_mtime_ns, versions, processor, sys.prefix))
    return cache_folder("llvm", sha256(key.encode()).hexdigest()[:24])


def _cached_trial(library: Library) -> Trial:
    """Return the stored trial of a library, or try it without Sionna. Only successful trials are stored."""
    note = _verdict_file(library)
    if note.is_file() and not _too_old(library.version):
        return Trial(library, True)
    trial = try_library(library, program=TRIAL_PROGRAM)
    if trial.ok:
        with suppress(OSError):  # without a writable cache, each run takes 0.5 s more
            note.parent.mkdir(parents=True, exist_ok=True)
            note.write_text(f"{library.label}\n")
    return trial


@cache
def _trials() -> tuple[Trial, ...]:
    """Return the trials that led to the choice of this process. The trials are made once per process."""
    return tuple(first_that_works(candidates(), _cached_trial))


def prepare_llvm() -> Path:
    """Select an LLVM that works for Dr.Jit. Call this before importing drjit, mitsuba or sionna.

    Returns
    -------
    Path
        The library. The path is now also in ``os.environ["DRJIT_LIBLLVM_PATH"]``.

    Raises
    ------
    SionnaMissingError
        If no usable LLVM is found. The message contains the command that installs a usable LLVM.
    """
    trials = _trials()
    if not trials or not trials[-1].ok or trials[-1].library is None:
        raise SionnaMissingError(f"{explain(trials)}. Repair it with: {remedy(trials)}")
    # Dr.Jit reads the variable only once, on import
    os.environ[LIBRARY_VARIABLE] = str(trials[-1].library.path)
    return trials[-1].library.path


def let_sionna_load() -> None:
    """Put ``Self`` into ``typing`` on Python 3.10, which does not have it.

    Sionna RT 2.2.0 supports Python 3.10, but imports this name from ``typing``.
    """
    import typing

    import typing_extensions

    vars(typing).setdefault("Self", typing_extensions.Self)


INSTALL_AGAIN = "pip install --force-reinstall sionna-rt"


def sionna_fails(trials: Sequence[Trial]) -> bool:
    """Check whether the last trial failed because of Sionna RT or a package that it needs, not because of LLVM."""
    return bool(trials) and not trials[-1].ok and not trials[-1].blames_library and not trials[-1].missing


def remedy(trials: Sequence[Trial]) -> str:
    """Return the command line that lets Sionna RT load after trials that failed."""
    if sionna_fails(trials):
        return INSTALL_AGAIN
    chosen = os.environ.get(LIBRARY_VARIABLE) and trials and not trials[-1].missing
    return f"unset {LIBRARY_VARIABLE}" if chosen else install_line()


def explain(trials: Sequence[Trial]) -> str:
    """Return a sentence with the reason why none of the tried libraries works."""
    if sionna_fails(trials):
        return f"Sionna RT cannot be loaded with any LLVM ({trials[-1].reason})"
    if not trials:
        return f"Dr.Jit needs LLVM {MINIMUM_MAJOR} or newer, and no libLLVM was found"
    tried = "; ".join(f"{trial.library.label if trial.library else 'GPU'}: {trial.reason}" for trial in trials)
    return f"Dr.Jit needs LLVM {MINIMUM_MAJOR} or newer, and none works here ({tried})"


# ---------------------------------------------------------------------------------------------- installing


def os_families() -> set[str]:
    """Return the names of the distribution and of related distributions, or of the operating system if it has none."""
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return {platform.system().lower()}
    # ID_LIKE names related distributions: for example, Mint and Pop are like Ubuntu
    return {release.get("ID", ""), *release.get("ID_LIKE", "").split()}


def apt_packages(search_output: str) -> list[str]:
    """Return LLVM runtime packages that are new enough, newest first, from the output of ``apt-cache search``.

    >>> apt_packages(os.linesep.join(["libllvm14 - x", "libllvm19 - x", "libllvm17t64 - x", "libllvm19-dbg - x"]))
    ['libllvm19', 'libllvm17t64']
    """
    packages = re.findall(r"^(libllvm(\d+)(?:t64)?)\s", search_output + "\n", flags=re.MULTILINE)
    new_enough = sorted(((int(major), name) for name, major in packages if int(major) >= MINIMUM_MAJOR), reverse=True)
    return [name for _, name in new_enough]


def known_to_apt() -> str:
    """Return the entries of apt's lists for LLVM runtimes of any version. Empty if there are no lists."""
    apt_cache = shutil.which("apt-cache")
    if apt_cache is None:
        return ""
    command = [apt_cache, "search", "--names-only", "^libllvm[0-9]+(t64)?$"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


# Commands that install LLVM on distributions without apt, by the family of the distribution.
_LINES = {
    **dict.fromkeys(("fedora", "rhel", "centos"), "sudo dnf install -y llvm-libs libatomic"),
    "arch": "sudo pacman -S --needed llvm-libs",
    **dict.fromkeys(("suse", "opensuse"), "sudo zypper install -y libLLVM19 libatomic1"),
    "darwin": "brew install llvm",
}


def install_line() -> str:
    """Return the command that installs LLVM on this machine."""
    families = os_families()
    if families & {"debian", "ubuntu"}:
        known = known_to_apt()
        offered = apt_packages(known)
        if known and not offered:  # Ubuntu 22.04 has only LLVM 15: use the LLVM project's packages
            # programs that the script calls, and that a minimal image does not contain
            needs = "wget gnupg lsb-release software-properties-common"
            fetch = "wget https://apt.llvm.org/llvm.sh && sudo bash llvm.sh 19"
            first = f"sudo apt-get update && sudo apt-get install -y {needs} && {fetch}"
            return f"{first} && sudo apt-get install -y libllvm19 {APT_RUNTIME}"
        package = next(iter(offered), "libllvm19")
        return f"sudo apt-get update && sudo apt-get install -y {package} {APT_RUNTIME}"
    for family, line in _LINES.items():
        if family in families:
            return line
    return f"export {LIBRARY_VARIABLE}=/path/to/libLLVM.so  # any LLVM of {MINIMUM_MAJOR} or newer"
