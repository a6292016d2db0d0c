"""PTX modules as libraries of this machine."""

import ctypes
import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ptx.translate import to_c

_HERE = Path(__file__).parent
# Only PTX's own fused operations are fused; integers wrap; memory is untyped.
_FLAGS = ("-ffp-contract=off", "-frounding-math", "-fwrapv", "-fno-strict-aliasing", "-U_FORTIFY_SOURCE", "-w")


def compiler() -> str | None:
    """Return the system's C compiler, None where there is none."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


class Range(ctypes.Structure):
    """Memory of a device: see machine.h."""

    _fields_ = [("begin", ctypes.c_uint64), ("end", ctypes.c_uint64), ("moved", ctypes.c_uint64)]


class Launch(ctypes.Structure):
    """How a grid is run: see machine.h."""

    _fields_ = [
        ("grid", ctypes.c_uint32 * 3),
        ("block", ctypes.c_uint32),
        ("shared_bytes", ctypes.c_uint32),
        ("order", ctypes.c_uint32),
        ("age", ctypes.c_uint64),
        ("ranges_count", ctypes.c_uint64),
        ("device_begin", ctypes.c_uint64),
        ("device_end", ctypes.c_uint64),
        ("ranges", ctypes.c_void_p),
        ("fault", ctypes.c_char * 256),
    ]


class Kernel:
    """A kernel of a module, in C; ``label`` is ``module:kernel``, without Warp's hashes."""

    def __init__(self, library: ctypes.CDLL, name: str, module: str = "") -> None:
        self.name = name
        plain, direction = name.split("_cuda_kernel_")
        self.label = f"{module}:{plain.rsplit('_', 1)[0]}{':backward' if direction == 'backward' else ''}"
        self._size = ctypes.c_uint32.in_dll(library, f"size_{name}").value
        self._pack = library[f"pack_{name}"]
        self._run = library[f"run_{name}"]

    def packed(self, args: Any) -> Any:
        """Return a copy of arguments, given as an array of pointers to them."""
        params = (ctypes.c_uint64 * (self._size // 8 + 1))()
        self._pack(args, params)
        return params

    def run(self, launch: Launch, params: Any) -> None:
        """Run a grid; raises RuntimeError where a thread touches what is not the device's."""
        if self._run(ctypes.byref(launch), params):
            raise RuntimeError(f"{self.name}: {launch.fault.decode()}")


def load(ptx: str, folder: Path, *, optimise: bool) -> ctypes.CDLL:
    """Return a PTX module as a library, compiled into ``folder`` unless it is there."""
    level = "-O1" if optimise else "-O0"
    flags = " ".join((level, *_FLAGS))
    parts: Iterable[bytes] = [ptx.encode("latin1"), flags.encode(), *(p.read_bytes() for p in sorted(_SOURCES))]
    digest = hashlib.sha256(b"\0".join(parts)).hexdigest()[:20]
    library = folder / f"ptx-{digest}.so"
    if not library.exists():
        found = compiler()
        assert found is not None, "callers look for a compiler first"
        partial = folder / f"ptx-{digest}-{os.getpid()}"
        source = partial.with_suffix(".c")
        source.write_text(to_c(ptx))
        command = [found, level, *_FLAGS, "-shared", "-fPIC", f"-I{_HERE}", str(source), "-o", f"{partial}.so", "-lm"]
        subprocess.run(command, check=True)
        os.replace(f"{partial}.so", library)
        source.unlink()
    return ctypes.CDLL(str(library))


_SOURCES = [
    *_HERE.glob("*.h"),
    *_HERE.glob("*instructions.py"),
    *(_HERE / f"{n}.py" for n in ("translate", "operands")),
]
