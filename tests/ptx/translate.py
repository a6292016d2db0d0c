"""From the text of a PTX module to the text of a C file with the same kernels."""

import re
from dataclasses import dataclass, field

from ptx.instructions import statement
from ptx.operands import UnknownPtxError, name_of

_REGISTERS = re.compile(r"\.reg\s+\.(\w+)\s+(%?\w+)(?:<(\d+)>)?$")
_VARIABLE = re.compile(
    r"(?:\.(?:visible|extern|weak|common)\s+)*\.(global|const|shared|local|param)\s+"
    r"(?:\.align\s+(\d+)\s+)?\.(\w+)\s+([\w$]+)(?:\[(\d*)\])?\s*(?:=\s*(.*))?$",
    re.DOTALL,
)
_ENTRY = re.compile(r"(?:\.(?:visible|weak)\s+)*\.entry\s+([\w$]+)\s*\((.*)\)", re.DOTALL)
_DEVICE_FUNCTION = re.compile(r"(?:\.(?:visible|weak)\s+)*\.func\s*(?:\(([^)]*)\))?\s*([\w$]+)\s*\((.*)\)", re.DOTALL)
_SIZES = {"8": 1, "16": 2, "32": 4, "64": 8}
_C_TYPES = {"pred": "pred", "f32": "f32", "f64": "f64", "b8": "u8", "b16": "u16", "b32": "u32", "b64": "u64"}


def size_of(kind: str) -> int:
    """Return the bytes of a type's name, such as ``u32``."""
    return _SIZES[kind[1:]]


@dataclass(frozen=True)
class Variable:
    """A module's, a function's or a parameter's piece of memory."""

    space: str
    align: int
    kind: str
    name: str
    bytes: int
    values: str | None


@dataclass
class Function:
    """What the translation of a kernel's instructions has to know, and what it finds."""

    name: str
    registers: dict[str, str] = field(default_factory=dict)
    params: dict[str, int] = field(default_factory=dict)
    shared: dict[str, int] = field(default_factory=dict)
    locals: dict[str, int] = field(default_factory=dict)
    globals: dict[str, Variable] = field(default_factory=dict)
    pointers: dict[str, str] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    together: bool = False
    sites: int = 0
    line: int = 0

    def site(self) -> str:
        """Return what an instruction remembers of where its last address lay."""
        self.sites += 1
        return f"&sites[{self.sites - 1}]"


def _variable(text: str) -> Variable | None:
    found = _VARIABLE.match(text)
    if found is None:
        return None
    space, align, kind, name, count, values = found.groups()
    size = size_of(kind)
    total = size * (int(count or 0) if count is not None else 1)
    return Variable(space, int(align or size), kind, name, total, values)


def _c_value(text: str) -> str:
    text = text.strip()
    if text.startswith(("0f", "0d")):
        return "0x" + text[2:] + "ull"
    return text.removesuffix("U") + ("ull" if not text.startswith("-") else "ll")


def _initialised(variable: Variable) -> str:
    """Return the definition in C of a global or constant variable."""
    kind, size = "u" + variable.kind[1:], size_of(variable.kind)
    values = (variable.values or "").strip().strip("{}")
    if re.search(r"[A-Za-z_$]{3,}", values.replace("0x", "")) and not values.startswith(("0f", "0d")):
        raise UnknownPtxError(f"variable {variable.name}: initialised with an address")
    listed = ", ".join(_c_value(v) for v in values.split(",") if v.strip()) or "0"
    storage = "static" if variable.space == "global" else "static const"
    count = max(variable.bytes // size, 1)
    return f"{storage} _Alignas({max(variable.align, 8)}) {kind} {variable.name}[{count}] = {{{listed}}};"


def _statements(text: str) -> list[tuple[int, str]]:
    """Return (line, statement) for each statement, label or brace of a function's body."""
    found, held, begun = [], "", 0
    for number, commented in enumerate(text.split("\n")):
        line = commented.split("//")[0].strip()
        # Braces around a statement of inline assembly, in which no register is declared.
        if not line or line.split()[0] in {".loc", ".pragma", ".file"} or (line == "{" and not held):
            continue
        label = re.match(r"^([\w$]+):$", line)
        if label and not held:
            found.append((number, line))
            continue
        for piece in re.split(r"(;)", line):
            if piece == ";":
                found.append((begun, " ".join(held.split()).lstrip("{ ")))
                held = ""
            elif piece.strip() and not (piece.strip() == "}" and not held):
                begun = begun if held else number
                held += " " + piece.strip()
    if held.strip():
        raise UnknownPtxError(f"a statement without an end: {held.strip()[:80]}")
    return found


def _parameters(text: str) -> list[Variable]:
    found = [(part.strip(), _variable(part.strip())) for part in text.split(",") if part.strip()]
    for part, parameter in found:
        if parameter is None:
            raise UnknownPtxError(f"parameter {part}")
    return [parameter for _, parameter in found if parameter is not None]


def _aligned(offset: int, align: int) -> int:
    return -(-offset // align) * align


def _body(function: Function, body: str, first_line: int) -> tuple[list[str], int, int]:
    """Return a function's statements in C with its registers, and its bytes of local and of shared memory."""
    local_size = shared_size = 0
    for variable in function.globals.values():
        if variable.space == "shared":
            function.shared[variable.name] = shared_size = _aligned(shared_size, variable.align)
            shared_size += variable.bytes
    lines: list[str] = []
    for number, text in _statements(body):
        function.line = first_line + number
        registers, variable = _REGISTERS.match(text), _variable(text)
        if text.endswith(":"):
            lines.append(f"{text[:-1].replace('$', 'L_')}:;")
        elif registers:
            kind, name, count = registers.groups()
            names = [f"{name}{i}" for i in range(int(count))] if count else [name]
            function.registers |= dict.fromkeys(names, _C_TYPES[kind])
        elif variable and variable.space == "shared":
            function.shared[variable.name] = shared_size = _aligned(shared_size, variable.align)
            shared_size += variable.bytes
        elif variable:
            # Also what a call hands over: each call has its own.
            function.locals[variable.name] = local_size = _aligned(local_size, max(variable.align, 8))
            local_size += variable.bytes
        else:
            lines.append("    " + statement(text, function))
    names = set(re.findall(r"\bR\w+", " ".join(lines)))
    declared = [f"    {kind} {name_of(r)};" for r, kind in function.registers.items() if name_of(r) in names]
    opening = [
        f"    Site *const sites = sites_{function.name}; (void)sites;",
        f"    _Alignas(16) unsigned char depot[{max(local_size, 1)}];",
        f"    t->local = (u64)depot; t->local_end = (u64)depot + {local_size};",
        "    const u64 param = t->param; (void)param;",
    ]
    return [*opening, *declared, *lines], local_size, shared_size


def _device_function(header: str, body: str, first_line: int, variables: dict[str, Variable]) -> tuple[str, set[str]]:
    """Return in C what kernels call, and the module's variables that it names."""
    found = _DEVICE_FUNCTION.match(header)
    if found is None:
        raise UnknownPtxError(f"a function: {header[:120]}")
    function = Function(found.group(2), globals=variables)
    function.pointers = {p.name: "answer" for p in _parameters(found.group(1) or "")}
    function.pointers |= {p.name: f"given[{i}]" for i, p in enumerate(_parameters(found.group(3)))}
    lines, _, _ = _body(function, body, first_line)
    sites = f"static Site sites_{function.name}[{max(function.sites, 1)}];"
    head = f"static void func_{function.name}(Thread *t, u64 answer, const u64 *given) {{"
    return "\n".join([sites, head, "    (void)answer; (void)given;", *lines, "}"]), function.used


def _entry(header: str, body: str, first_line: int, variables: dict[str, Variable]) -> tuple[str, set[str]]:
    """Return a kernel in C, and the module's variables that it names."""
    found = _ENTRY.match(header)
    if found is None:
        raise UnknownPtxError(f"a function that is no kernel: {header[:120]}")
    function = Function(found.group(1), globals=variables)
    copies, size = [], 0
    for number, parameter in enumerate(_parameters(found.group(2))):
        function.params[parameter.name] = size = _aligned(size, max(parameter.align, 8))
        copies.append(f"    memcpy((unsigned char *)params + {size}, args[{number}], {parameter.bytes});")
        size += parameter.bytes
    lines, _, shared_size = _body(function, body, first_line)
    name = function.name
    c = [
        f"static Site sites_{name}[{max(function.sites, 1)}];",
        f"static void body_{name}(Thread *t) {{",
        *lines,
        "}",
        f"const u32 size_{name} = {size};",
        f"void pack_{name}(void **args, void *params) {{",
        *copies,
        "}",
        f"int run_{name}(Launch *launch, void *params) {{",
        f"    return run_grid(launch, body_{name}, {int(function.together)}, (u64)params, (u64)params + {size},",
        f"                    {shared_size});",
        "}",
    ]
    return "\n".join(c), function.used


def to_c(ptx: str) -> str:
    """Return C with functions for each kernel of a PTX module.

    ``pack_kernel(void **args, void *params)`` copies arguments, of ``size_kernel`` bytes, as a launch does;
    ``run_kernel(Launch *, void *params)`` runs it.

    Raises UnknownPtxError, which names it, for what is not among the instructions that this knows.
    """
    ptx = ptx.rstrip("\0")
    variables: dict[str, Variable] = {}
    parts: list[str] = []
    said: list[str] = []
    used: set[str] = set()
    position = 0
    while match := re.compile(r"(\.visible|\.weak|\.entry|\.func|\.global|\.const|\.shared|\.extern)\b").search(
        ptx, position
    ):
        start = match.start()
        end, brace = ptx.index(";", start), re.compile(r"^\{", re.MULTILINE).search(ptx, start)
        called = re.match(r"(?:\.(?:visible|weak|extern)\s+)*\.func\b", ptx[start : start + 80])
        if brace is None or end < brace.start():
            variable = _variable(ptx[start:end])
            if variable is not None and variable.space == "shared" and variable.bytes == 0:
                raise UnknownPtxError(f"{variable.name}: shared memory whose size a launch tells")
            if variable is not None:
                variables[variable.name] = variable
            elif not called:  # else it is only said to come
                raise UnknownPtxError(ptx[start:end][:120])
            position = end + 1
            continue
        close = re.compile(r"^\}", re.MULTILINE).search(ptx, brace.end())
        assert close is not None, "a function's body ends"
        translated = _device_function if called else _entry
        header, body = ptx[start : brace.start()].strip(), ptx[brace.end() : close.start()]
        c, names = translated(header, body, ptx.count("\n", 0, brace.end()) + 1, variables)
        if called:
            said.append(re.sub(r" \{$", ";", c.split("\n")[1]))
        parts.append(c)
        used |= names
        position = close.end()
    held = [_initialised(variable) for name, variable in variables.items() if name in used]
    own = [f"(a >= (u64){name} && a + n <= (u64){name} + sizeof {name})" for name in sorted(used)]
    known = f"static int is_modules_own(u64 a, unsigned n) {{ return {' || '.join(own) or '0'}; }}"
    return "\n".join(['#include "machine.h"', *held, known, *said, *parts, ""])
