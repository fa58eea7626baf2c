"""Changes of files that a reader must survive: of JSON, of named tensors, and of bytes."""

import io
import json
import math
import zipfile

import torch

DEEP = "@@deep@@"
STRANGE = (
    None, True, False, -1, 0, 1, 0.5, -0.0, 1e308, -1e308, 2**31, 2**63 - 1, 2**63, 2**64, 10**30, math.nan, math.inf,
    "", "x", "x\ny", "\udc80", "é" * 50, [], {}, [None], {"": None}, [[[]]], {"a": {"b": []}}, DEEP,
)  # fmt: skip


def bytes_of(whole, dice):
    """A copy with a few bytes changed, cut short, or with something inserted."""
    at = dice.randrange(len(whole) + 1)
    how = dice.randrange(4)
    if how == 0:
        return whole[:at]
    if how == 1:
        return whole[:at] + dice.randbytes(dice.randrange(1, 9)) + whole[at:]
    changed = bytearray(whole)
    for _ in range(dice.randrange(1, 5) if whole else 0):
        changed[dice.randrange(len(whole))] ^= 1 << dice.randrange(8)
    return bytes(changed)


# ---- JSON


def _places(value, path=()):
    """Paths of all that lies inside."""
    items = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from _places(inner, (*path, key))


def json_of(text, dice):
    """The text of an object with some of its values changed, added or missing."""
    value = json.loads(text)
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        places = list(_places(value))
        if not places:
            break
        *path, last = dice.choice(places)
        holder = value
        for key in path:
            holder = holder[key]
        _change(holder, last, value, dice)
    text = json.dumps(value, indent=1)
    depth = dice.choice((20, 1000, 100_000))
    return text.replace(json.dumps(DEEP), dice.choice(("[" * depth + "]" * depth, '{"a":' * depth + "1" + "}" * depth)))


def _change(holder, key, whole, dice):
    how = dice.randrange(6)
    if how == 0:
        del holder[key]
    elif how == 1 and isinstance(holder, dict):
        holder[dice.choice(("", "more", "metric\n", key + "s"))] = dice.choice(STRANGE)
    elif how == 2 and isinstance(holder[key], list):
        length = dice.choice((0, 1, len(holder[key]) - 1, len(holder[key]) + 1, 10_000))
        holder[key] = (holder[key] * 20_000)[: max(0, length)]
    elif how == 3 and isinstance(holder[key], (int, float)):
        holder[key] = dice.choice((-holder[key], holder[key] * 1e9, str(holder[key]), [holder[key]]))
    else:
        holder[key] = dice.choice(STRANGE)


# ---- named tensors


def tensors_of(content, dice):
    """The bytes of named tensors, a tuple of names and tensors by turns or a dict, changed."""
    if dice.random() < 0.25:
        return archive_of(content, dice) if dice.random() < 0.5 else bytes_of(content, dice)
    loaded = torch.load(io.BytesIO(content), weights_only=True)
    is_dict = isinstance(loaded, dict)
    pairs = [list(pair) for pair in (loaded.items() if is_dict else zip(loaded[::2], loaded[1::2], strict=True))]
    for _ in range(dice.choice((1, 1, 1, 2, 4))):
        if pairs:
            _change_pair(pairs, dice)
    made = {name: value for name, value in pairs} if is_dict else tuple(part for pair in pairs for part in pair)
    if dice.random() < 0.03:
        made = dice.choice((None, 3, [], {}, (), "text", [made], {"state": made}, made[:-1] if not is_dict else None))
    out = io.BytesIO()
    torch.save(made, out)
    return out.getvalue()


def _change_pair(pairs, dice):
    place = dice.randrange(len(pairs))
    one = pairs[place]
    name, tensor = one
    how = dice.randrange(8)
    if how == 0:
        del pairs[place]
    elif how == 1:
        one[0] = dice.choice((f"{name}x", "", "a\nb", 3, None, dice.choice(pairs)[0]))
    elif how == 2:
        pairs.append([dice.choice(("more", name, "network.more")), tensor])
    elif how == 3:
        one[1] = dice.choice((None, 3, 0.5, "x", [], [tensor], {"a": tensor}, (1, 2), dice.choice(pairs)[1]))
    elif isinstance(tensor, torch.Tensor):
        one[1] = _changed(tensor, dice) if how < 6 else _with_values(tensor, dice)


def _changed(tensor, dice):
    """Of another dtype or shape."""
    flat = tensor.reshape(-1)
    dtypes = (torch.float16, torch.float32, torch.float64, torch.int32, torch.int64, torch.bool, torch.complex64)
    return dice.choice(
        (
            lambda: tensor.to(dice.choice(dtypes)),
            lambda: flat[:-1].clone(),
            lambda: torch.cat([flat, flat[:1]]),
            lambda: flat[:0].clone(),
            lambda: tensor[None].clone(),
            lambda: tensor.expand(3, *tensor.shape),
            lambda: tensor.mT.contiguous() if tensor.dim() > 1 else tensor[None, None].clone(),
        )
    )()


def _with_values(tensor, dice):
    changed = tensor.clone().reshape(-1)
    if changed.numel() == 0:
        return tensor
    strange = (-1.0, 0.0, 1.0, 1e30, math.nan, math.inf, -math.inf)
    if not tensor.is_floating_point():
        strange = (-1, 0, 1, 2**7 - 1) if tensor.element_size() == 1 else (-1, 0, 1, 2**31 - 1)
    value = dice.choice(strange)
    if tensor.dtype == torch.uint8:
        value = abs(value)
    if tensor.dtype == torch.bool:
        return tensor
    if dice.random() < 0.5:
        changed[dice.randrange(changed.numel())] = value
    else:
        changed.fill_(value)
    return changed.reshape(tensor.shape)


def archive_of(content, dice):
    """The archive with bytes of one of its files changed, and the sums that belong to them."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as before, zipfile.ZipFile(out, "w") as after:
        names = before.namelist()
        chosen = dice.choice([name for name in names if name.endswith("data.pkl")] * 3 + names)
        for name in names:
            part = before.read(name)
            after.writestr(name, _changed_part(part, dice) if name == chosen else part)
    return out.getvalue()


def _changed_part(part, dice):
    """Changed at its head, which says how the rest is read, or anywhere."""
    head = 128 if dice.random() < 0.5 else len(part)
    return bytes_of(part[:head], dice) + part[head:]
