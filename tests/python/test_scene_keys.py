"""The list of scene keys, which the documentation shows, says what the reader of scenes does."""

import re
import tomllib

import pytest
from helpers import as_toml

from docs import scene_keys
from prdp_torch.experiments import _C, scenes

KEYS = _C.scene_keys()


def corpus():
    """The project's scenes and variants of them that have the other keys, as {name: content}."""
    read = {name: tomllib.loads(path.read_text()) for name, path in scenes.available().items()}
    for name in ("heat_1d", "navier_stokes"):
        made = ("modes", "seed", "reference_shape")
        data = {key: value for key, value in read[name]["data"].items() if key not in made}
        read[f"{name} from a file"] = read[name] | {"data": data | {"file": "x.h5"}}
    chebyshev = {"solver": read["heat_1d"]["solver"] | {"method": "chebyshev"}}
    no_decay = {key: value for key, value in read["heat_1d"]["training"].items() if not key.startswith("decay")}
    cosine = {"training": no_decay | {"cosine_updates": 10}}
    read["heat_1d with chebyshev and cosine"] = read["heat_1d"] | chebyshev | cosine
    return read


def applies(words, content):
    """Whether a condition in the words of the list holds: "only for `a` and `b`, not with `c`"."""
    chosen = {content["task"], content["physics"]["equation"], content["solver"]["method"]}
    chosen |= {content.get("network", {}).get("kind")}
    chosen |= {*content.get("data", {}), *content["training"]}
    for part in filter(None, re.split(", (?=only|not)", words)):
        relation, names = part.split("`", 1)[0].strip(), set(re.findall("`(.*?)`", part))
        assert relation in ("only for", "not for", "not with"), part
        if bool(names & chosen) != (relation == "only for"):
            return False
    return True


def an_example(value):
    """A value that the list allows for a key, and one that it does not allow."""
    kind, _, bound = value.removesuffix(", or a list of them").partition(" >")
    least = 1e6 if "`" in bound else float(bound.strip("= ") or 0)  # a bound by another key is below a million
    simple = {
        "table": ({}, 1),
        "table, or text `module:Class`": ({}, "Class"),
        "numbers": ([1.0], 1.0),
        "number in (0, 1]": (0.5, 1.5),
        "text": ("x", 1),
        "`true`, `false`": (True, 1),
    }
    if value in simple:
        return simple[value]
    if kind == "number":
        return least + 1, least - bound.startswith("=")
    if kind == "whole number":
        return int(least), -1 if "`" in bound else int(least) - 1
    return ([int(least)], [int(least) - 1]) if kind == "whole numbers" else (value.split("`")[1], "nonsense")


def changed(content, key, value):
    """The content with this value for the key, or without the key if the value is None."""
    table = content[key["table"]] if key["table"] else content
    table = {name: old for name, old in table.items() if name != key["name"]}
    if value is not None:
        table[key["name"]] = value
    return content | {key["table"]: table} if key["table"] else table


def load(content):
    return _C.parse_scene(as_toml(content), "scene.toml")


@pytest.mark.parametrize("name, content", corpus().items(), ids=corpus())
def test_the_list_says_when_a_key_applies_and_whether_it_is_required(name, content):
    load(content)
    listed = {(key["table"], key["name"]) for key in KEYS}
    for table, inner in {"": content, **{k: v for k, v in content.items() if isinstance(v, dict)}}.items():
        assert {(table, name) for name in inner} <= listed
    for key in KEYS:
        if key["table"] and key["table"] not in content:
            continue
        full = re.escape(".".join(filter(None, (key["table"], key["name"]))))
        allowed, refused = an_example(key["value"])
        if not applies(key["when"], content):
            with pytest.raises(ValueError, match=rf"scene.toml:\d+: {full}: {re.escape(key['when'])}"):
                load(changed(content, key, allowed))
            continue
        with pytest.raises(ValueError, match=rf"scene.toml:\d+: {full}: (expected|must be|unknown name)"):
            load(changed(content, key, refused))
        if key["default"] is None:
            with pytest.raises(ValueError, match=f"{full}: missing"):
                load(changed(content, key, None))
        elif key["name"] not in ("file", "cosine_updates"):  # these replace other keys
            load(changed(content, key, None))


@pytest.mark.parametrize("content", corpus().values(), ids=corpus())
def test_the_list_says_which_names_a_scene_may_choose(content):
    for key in KEYS:
        if not key["value"].startswith("`") or key["table"] not in ("", *content) or key["name"] == "zero_output":
            continue
        for group in key["value"].split("; "):
            names, words = re.fullmatch(r"([^(]*)(?: \((.*)\))?", group).groups()
            for name in re.findall("`(.*?)`", names):
                if not applies(words or "", content):
                    with pytest.raises(ValueError, match=f"'{name}' is {re.escape(words)}"):
                        load(changed(content, key, name))
                else:
                    try:  # other keys may not fit to the new name
                        load(changed(content, key, name))
                    except ValueError as error:
                        assert f"'{name}'" not in str(error)


def test_the_defaults_are_those_of_a_scene_without_the_keys():
    content = tomllib.loads(scenes.available()["heat_1d"].read_text())
    scene = load(content)
    read = {
        ("", "device"): f"`{scene.device}`",
        ("physics", "length"): f"{scene.physics.length[0]:g}",
        ("solver", "on_failure"): f"`{scene.on_failure}`",
        ("solver", "start"): f"`{scene.start}`",
        ("solver", "preconditioner"): f"`{scene.preconditioner or 'none'}`",
        ("data", "file"): scene.data.file or "none",
        ("data", "fresh"): f"`{str(scene.data.fresh).lower()}`",
        ("data", "trained_steps"): str(scene.data.trained_steps),
        ("network", "zero_output"): f"`{str(scene.network.zero_output).lower()}`",
        ("prdp", "growth"): f"{scene.prdp['growth']:g}",
        ("prdp", "maximum"): str(scene.prdp["maximum"]).lower(),
        ("prdp", "adjoint_ratio"): str(scene.prdp["adjoint_ratio"]).lower(),
    }
    optional = {(key["table"], key["name"]): key["default"] for key in KEYS if key["default"] is not None}
    assert {key: optional.pop(key) for key in read} == read
    assert set(optional.values()) == {"none"}


def test_the_page_shows_the_list():
    page = scene_keys.PAGE.read_text()
    assert page == scene_keys.with_tables(page), "run: python -m docs.scene_keys"
    tables = {key["table"] or "the top level" for key in KEYS}
    assert {found[2].removeprefix("the keys of ") for found in scene_keys.TABLE.finditer(page)} == tables
