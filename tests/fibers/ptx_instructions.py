"""The instructions of PTX as lines of C++, over the functions of ptx.h."""

import re

TYPES = {
    "pred": "bool",
    **{f"{kind}{bits}": f"uint{bits}_t" for kind in "ub" for bits in (8, 16, 32, 64)},
    **{f"s{bits}": f"int{bits}_t" for bits in (8, 16, 32, 64)},
    "f32": "float",
    "f64": "double",
}
SPECIAL = {
    "%tid.x": "threadIdx.x",
    "%ntid.x": "blockDim.x",
    "%ctaid.x": "blockIdx.x",
    "%nctaid.x": "gridDim.x",
    "%laneid": "(threadIdx.x % 32)",
}
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "rem": "%", "and": "&", "or": "|", "xor": "^"}
COMPARISONS = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "lo": "<", "ls": "<=", "hi": ">"}
COMPARISONS["hs"] = ">="
ROUNDINGS = {"rni": "nearbyint", "rzi": "trunc", "rmi": "floor", "rpi": "ceil"}
# Functions of ptx.h and of the standard library of one argument, and of more, of the instruction's type T.
UNARY = {
    "abs": "magnitude<T>({})",
    "neg": "-{}",
    "not": "~{}",
    "rcp": "T(1) / {}",
    "sqrt": "std::sqrt({})",
    "ex2": "std::exp2({})",
    "clz": "std::countl_zero(static_cast<std::make_unsigned_t<T>>({}))",
    "popc": "std::popcount(static_cast<std::make_unsigned_t<T>>({}))",
}
OTHERS = {
    "fma": "std::fma({}, {}, {})",
    "min": "least<T>({}, {})",
    "max": "most<T>({}, {})",
    "bfe": "bits_of({}, {}, {})",
    "prmt": "permuted({}, {}, {})",
}
SHARED_READS = ("volatile", "cg", "cv", "relaxed", "acquire")  # loads of what other blocks may have written

# 1/x in log(), whose result only says when to look next, and 2^n in ldexp(), whose n is whole.
EXACT_HERE = ("rcp.approx.ftz.f64", "ex2.approx.ftz.f32")
# Modifiers that change bits and are not translated.
REFUSED = {"NaN", "approx", "ftz", "full", "sat", "rz", "rm", "rp", "warp", "f4e", "b4e", "rc8", "ecl", "ecr", "rc16"}


class Unknown(Exception):
    """An instruction or an operand that is not translated."""


def split(text):
    """By commas that are not within brackets."""
    parts, depth, part = [], 0, ""
    for letter in text:
        depth += (letter in "{[(") - (letter in "}])")
        if letter == "," and depth == 0:
            parts.append(part.strip())
            part = ""
        else:
            part += letter
    return parts + ([part.strip()] if part.strip() else [])


def in_cpp(name):
    """A name of PTX as one of C++."""
    return "m_" + name.strip().replace("$", "_S_").replace("%", "_P_")


def register_name(register):
    return "r_" + register.strip().lstrip("%")


def label(name):
    return "L_" + name.strip().replace("$", "_S_")


def bits_of_literal(text):
    return int(text[2:], 16) if text[:2] in ("0d", "0f") else int(text.rstrip("U"), 0)


class Instructions:
    """Those of a function. `kinds` has the type of each register, or of all with a prefix; `places`, the expression of
    each name that stands for memory; `targets`, the labels of each table of jumps."""

    def __init__(self, kinds, places, targets):
        self.kinds, self.places, self.targets = kinds, places, targets

    def line(self, text):
        guard = re.match(r"@(!?)(%\w+)\s+", text)
        if guard:
            return f"if ({guard[1]}{register_name(guard[2])}) {{ {self.line(text[guard.end() :])} }}"
        operation, _, rest = text.partition(" ")
        parts, args = operation.split("."), split(rest)
        kinds = [part for part in parts if part in TYPES]
        translate = getattr(self, f"_{parts[0]}", None)
        if translate is not None and not REFUSED & set(parts):
            return translate(parts, kinds, args)
        if operation not in EXACT_HERE and REFUSED & set(parts):
            raise Unknown(operation)
        return self._arithmetic(parts, kinds, args)

    # ---- operands

    def value(self, operand, kind):
        """An expression of this type."""
        operand, t = operand.strip(), TYPES[kind]
        if operand in SPECIAL:
            return f"as<{t}>(static_cast<uint32_t>({SPECIAL[operand]}))"
        if operand.startswith("!"):
            return f"!{register_name(operand[1:])}"
        if operand.startswith("%") or operand in self.kinds:
            return f"as<{t}>({register_name(operand)})"
        if re.fullmatch(r"0[df][0-9A-Fa-f]+", operand):
            return f"as<{t}>(uint{64 if operand[1] == 'd' else 32}_t{{0x{operand[2:]}ull}})"
        if re.fullmatch(r"-?\d+U?|0x[0-9a-fA-F]+U?", operand) and kind[0] != "f":
            number = bits_of_literal(operand)
            return str(bool(number)).lower() if kind == "pred" else f"static_cast<{t}>({number & (2**64 - 1)}ull)"
        if operand in self.places:
            return f"as<{t}>({self.places[operand]})"
        raise Unknown(f"{operand} as {kind}")

    def values(self, operands, kind):
        return [self.value(operand, kind) for operand in operands]

    def address(self, operand):
        base, _, offset = operand.strip()[1:-1].partition("+")
        place = self.places.get(base.strip()) or register_name(base)
        return f"({place} + static_cast<uint64_t>({int(offset or '0', 0)}ll))"

    def put(self, register, kind, expression):
        register = register.strip()
        if register == "_":
            return f"(void)({expression});"
        own = self.kinds.get(register) or self.kinds[re.match(r"%?[a-zA-Z]+", register)[0]]
        return f"{register_name(register)} = to_register<{TYPES[own]}>(static_cast<{TYPES[kind]}>({expression}));"

    # ---- arithmetic

    def _arithmetic(self, parts, kinds, args):
        name, kind = parts[0], kinds[0]
        t = TYPES[kind]
        if "cc" in parts or name in ("addc", "subc", "madc"):
            return self._with_carry(parts, kind, args)
        if "wide" in parts or "hi" in parts:
            return self._product(name, "hi" in parts, kind, args)
        if kind[0] == "s" and name in ("add", "sub", "mul", "mad"):
            kind = "u" + kind[1:]  # which wraps
        given = self.values(args[1:], kind)
        if name == "mad":
            return self.put(args[0], kind, "{} * {} + {}".format(*given))
        if name in INFIX:
            return self.put(args[0], kind, f"{given[0]} {INFIX[name]} {given[1]}")
        if name == "not" and kind == "pred":
            return self.put(args[0], kind, f"!{given[0]}")
        if name in UNARY:
            expression = UNARY[name].replace("<T>", f"<{t}>").replace("T(", f"{t}(").format(*given)
            return self.put(args[0], "u32" if name in ("clz", "popc") else kind, expression)
        if name in OTHERS and (name != "bfe" or kind == "u32"):
            kind = "u32" if name == "prmt" else kind
            expression = OTHERS[name].replace("<T>", f"<{t}>").format(*self.values(args[1:], kind))
            return self.put(args[0], kind, expression)
        raise Unknown(".".join(parts))

    def _product(self, name, high, kind, args):
        """All bits of a product, or the upper half of them."""
        a, b = self.values(args[1:3], kind)
        if high:
            wide = "unsigned __int128" if kind[0] == "u" else "__int128"
            added = f" + {self.value(args[3], kind)}" if name == "mad" else ""
            return self.put(args[0], kind, f"((static_cast<{wide}>({a}) * {b}) >> {kind[1:]}){added}")
        wide = kind[0] + str(2 * int(kind[1:]))
        added = f" + {self.value(args[3], wide)}" if name == "mad" else ""
        return self.put(args[0], wide, f"static_cast<{TYPES[wide]}>({a}) * {b}{added}")

    def _with_carry(self, parts, kind, args):
        """A sum or difference of 32 bits, which takes the carry flag or leaves it, as in the sine of a large number."""
        name, given = parts[0], self.values(args[1:], kind)
        if kind != "u32" or name not in ("add", "addc", "sub", "subc", "mad", "madc"):
            raise Unknown(".".join(parts))
        first = given[0]
        if name.startswith("mad"):
            product = f"static_cast<uint64_t>({given[0]}) * {given[1]}"
            first = f"({product}) >> 32" if "hi" in parts else f"static_cast<uint32_t>({product})"
        sign = "-" if name.startswith("sub") else "+"
        taken = f" {sign} carry" if name.endswith("c") else ""
        left = " carry = sum >> 32 & 1;" if "cc" in parts else ""
        sum_ = f"static_cast<uint64_t>({first}) {sign} {given[-1]}{taken}"
        return f"{{ const uint64_t sum = {sum_};{left} " + (
            self.put(args[0], kind, "static_cast<uint32_t>(sum)") + " }"
        )

    def _shift(self, function, kinds, args):
        t = TYPES[kinds[0]]
        return self.put(
            args[0], kinds[0], f"{function}<{t}>({self.value(args[1], kinds[0])}, {self.value(args[2], 'u32')})"
        )

    def _shl(self, parts, kinds, args):
        return self._shift("shift_left", kinds, args)

    def _shr(self, parts, kinds, args):
        return self._shift("shift_right", kinds, args)

    def _shf(self, parts, kinds, args):
        if parts[2] != "wrap":
            raise Unknown(".".join(parts))
        function = "funnel_left" if parts[1] == "l" else "funnel_right"
        return self.put(args[0], "u32", "{}({}, {}, {})".format(function, *self.values(args[1:], "u32")))

    def _bfi(self, parts, kinds, args):
        kind = "u" + kinds[0][1:]
        given = [*self.values(args[1:3], kind), *self.values(args[3:], "u32")]
        return self.put(args[0], kind, "with_bits<{}>({}, {}, {}, {})".format(TYPES[kind], *given))

    def _copysign(self, parts, kinds, args):
        sign, size = self.values(args[1:], kinds[0])
        return self.put(args[0], kinds[0], f"std::copysign({size}, {sign})")

    def _cvt(self, parts, kinds, args):
        to, source = kinds
        x = self.value(args[1], source)
        rounding = next((ROUNDINGS[part] for part in parts if part in ROUNDINGS), None)
        if source[0] == "f" and rounding:
            x = f"std::{rounding}({x})"
            if to[0] != "f":
                x = f"to_integer<{TYPES[to]}>({x})"
        return self.put(args[0], to, x)

    # ---- choices

    def _selp(self, parts, kinds, args):
        yes, no = self.values(args[1:3], kinds[0])
        return self.put(args[0], kinds[0], f"{self.value(args[3], 'pred')} ? {yes} : {no}")

    def _setp(self, parts, kinds, args):
        how, (a, b) = parts[1], self.values(args[1:3], kinds[0])
        either_is_nan = f"(std::isnan({a}) || std::isnan({b}))"
        if how in ("nan", "num"):
            found = either_is_nan if how == "nan" else f"!{either_is_nan}"
        elif kinds[0][0] == "f" and how not in COMPARISONS:  # true of NaN as well
            found = f"({a} {COMPARISONS[how[:-1]]} {b} || {either_is_nan})"
        elif kinds[0][0] == "f":
            found = f"({a} {COMPARISONS[how]} {b} && !{either_is_nan})"
        else:
            found = f"({a} {COMPARISONS[how]} {b})"
        joined = {"and": " && {}", "or": " || {}", "xor": " != {}"}
        join = next((joined[part].format(self.value(args[3], "pred")) for part in parts[2:] if part in joined), "")
        to, *other = args[0].split("|")
        made = f"const bool found = {found}, first = found{join}, second = !found{join}; "
        lines = [self.put(to, "pred", "first"), *(self.put(register, "pred", "second") for register in other)]
        return "{ [[maybe_unused]] " + made + " ".join(lines) + " }"

    # ---- memory

    def _mov(self, parts, kinds, args):
        to, source = args
        whole = "u" + kinds[0][1:]
        if to.startswith("{"):
            registers = split(to.strip("{} "))
            bits = int(whole[1:]) // len(registers)
            shifted = [f"{self.value(source, whole)} >> {k * bits}" for k in range(len(registers))]
            return " ".join(self.put(r, f"u{bits}", v) for r, v in zip(registers, shifted, strict=True) if r != "_")
        if source.startswith("{"):
            registers = split(source.strip("{} "))
            bits = int(whole[1:]) // len(registers)
            values = self.values(registers, f"u{bits}")
            joined = " | ".join(f"static_cast<{TYPES[whole]}>({v}) << {k * bits}" for k, v in enumerate(values))
            return self.put(to, whole, joined)
        return self.put(to, kinds[0], self.value(source, kinds[0]))

    def _cvta(self, parts, kinds, args):
        return self.put(args[0], "u64", self.value(args[1], "u64"))

    def _ld(self, parts, kinds, args):
        t, registers = TYPES[kinds[0]], split(args[0].strip("{} "))
        read = "load_of_others" if "shared" not in parts and set(SHARED_READS) & set(parts) else "load"
        size, address = int(kinds[0][1:]) // 8, self.address(args[1])
        loads = [f"const auto l{k} = {read}<{t}>({address} + {k * size});" for k in range(len(registers))]
        return "{ " + " ".join(loads + [self.put(r, kinds[0], f"l{k}") for k, r in enumerate(registers)]) + " }"

    def _st(self, parts, kinds, args):
        values = self.values(split(args[1].strip("{} ")), kinds[0])
        size, address = int(kinds[0][1:]) // 8, self.address(args[0])
        return " ".join(f"store<{TYPES[kinds[0]]}>({address} + {k * size}, {v});" for k, v in enumerate(values))

    def _atom(self, parts, kinds, args):
        *to, place, amount = args
        if "add" not in parts or kinds != ["u32"]:
            raise Unknown(".".join(parts))
        at = f"reinterpret_cast<uint32_t*>({self.address(place)})"
        old = f"__atomic_fetch_add({at}, {self.value(amount, 'u32')}, __ATOMIC_SEQ_CST)"
        return self.put(to[0], "u32", old) if to else f"{old};"

    _red = _atom

    # ---- the order of threads

    def _bar(self, parts, kinds, args):
        if "sync" not in parts or len(args) > 1:
            raise Unknown(".".join(parts))
        return "fibers::meet(1);"  # a compiler may copy a barrier, so its place is no matter

    _barrier = _bar

    def _fence(self, parts, kinds, args):
        return "std::atomic_thread_fence(std::memory_order_seq_cst);"

    _membar = _fence

    def _shfl(self, parts, kinds, args):
        if parts[1:3] != ["sync", "bfly"]:
            raise Unknown(".".join(parts))
        given, lane = self.value(args[1], "u32"), self.value(args[2], "s32")
        return self.put(args[0].partition("|")[0], "b32", f"__shfl_xor_sync(~0u, {given}, {lane}, 1)")

    def _bra(self, parts, kinds, args):
        return f"goto {label(args[0])};"

    def _brx(self, parts, kinds, args):
        cases = " ".join(f"case {k}: goto {label(target)};" for k, target in enumerate(self.targets[args[1]]))
        return f"switch ({self.value(args[0], 'u32')}) {{ {cases} }}"

    def _ret(self, parts, kinds, args):
        return "return;"

    _exit = _ret

    def _trap(self, parts, kinds, args):
        return "std::abort();"

    def _call(self, parts, kinds, args):
        *result, name = args[: 2 if args[0].startswith("(") else 1]
        given = split(args[len(result) + 1].strip("() ")) if len(args) > len(result) + 1 else []
        passed = [in_cpp(result[0].strip("() ")) if result else "nullptr", *map(in_cpp, given)]
        return f"{in_cpp(name)}({', '.join(passed)});"
