"""Configuration: read from YAML, overridden by dotted keys, fingerprinted, and written with comments."""

import difflib
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from schemas.config import Config
from schemas.error_text import represent
from tableverse_factory.core.errors import ConfigError

MAX_FILE_BYTES = 1024 * 1024
_BOUNDS = {
    "exclusiveMinimum": "more than",
    "minimum": "at least",
    "exclusiveMaximum": "less than",
    "maximum": "at most",
}
_MAX_PROBLEMS = 4  # Problems with one remedy that are listed
RUNTIME_SECTIONS = frozenset({"asking"})  # Sections that may change between runs of a build
_OVERRIDE_PREFIX = "--set or override: "  # Start of messages about overrides


_TAG_ERRORS = (ValueError, KeyError, IndexError, AttributeError)  # of `!!bool maybe`, `!!int ''`, `!!timestamp x`


_NUMBER_TAGS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")


class _StrictLoader(yaml.SafeLoader):
    """Safe YAML without aliases, which can blow up, repeated keys, and numbers of base 8 (010) and 60 (1:30)."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ConfigError("aliases (*name) are not allowed")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ConfigError(f"line {key.start_mark.line + 1}: a key is a word")
            if key.value in seen:
                raise ConfigError(f"line {key.start_mark.line + 1}: key {represent(key.value)} stands twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep)


# Of YAML 1.1 a leading zero means base 8, and colons base 60: no one means that of a seed or a length.
_StrictLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _NUMBER_TAGS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:int", re.compile(r"[-+]?(0|[1-9][0-9_]*)$"), list("-+0123456789")
)
_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
    ),
    list("-+0123456789."),
)


def load_config(path: Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """Load the configuration: defaults, then the file, then overrides such as `rectify.clearance_m=0.001`."""
    tree: dict[str, Any] = {} if path is None else load_yaml(path)
    return build_config(tree, overrides, "" if path is None else f"{path}: ")


def build_config(tree: Mapping[str, Any], overrides: Sequence[str] = (), origin: str = "") -> Config:
    """Build the configuration from sections and `overrides`; `origin` starts messages about the sections."""
    sections, overridden = dict(tree), set[str]()
    for override in overrides:
        key, value = _parse_override(override)
        _set_key(sections, key, value)
        overridden.add(key)
    try:
        return Config.model_validate(sections)
    except ValidationError as error:
        found = error.errors()
        problems = [
            (_OVERRIDE_PREFIX if _is_overridden(problem["loc"], overridden) else origin, *_explain(problem))
            for problem in found
            if not any(_is_within(other["loc"], problem["loc"]) for other in found)  # a list lacks its wrong values
        ]
        # Of a list that is too short pydantic gives one problem for each value that it lacks
        raise ConfigError(_join_problems([*dict.fromkeys(problems)])) from None


def _is_within(location: tuple[int | str, ...], outer: tuple[int | str, ...]) -> bool:
    return len(location) > len(outer) and location[: len(outer)] == outer


def _join_problems(problems: Sequence[tuple[str, str, str]]) -> str:
    """Join problems by origin; a remedy that several share is named once, behind the last of them."""
    joined = []
    for origin in dict.fromkeys(its for its, _, _ in problems):
        remedies: dict[str, list[str]] = {}
        for _, text, remedy in (problem for problem in problems if problem[0] == origin):
            remedies.setdefault(remedy, []).append(text)
        for remedy, same in remedies.items():
            is_long = remedy and len(same) > _MAX_PROBLEMS
            shown = [*same[:_MAX_PROBLEMS], f"and {len(same) - _MAX_PROBLEMS} more"] if is_long else same
            joined.append("; ".join([*shown, remedy] if remedy else shown))
        joined[-len(remedies)] = origin + joined[-len(remedies)]
    return "; ".join(joined)


def fingerprint_config(config: Config) -> str:
    """Hash the canonical JSON of every value that affects the output (sha256)."""
    return fingerprint_tree(select_output_affecting(config))


def select_output_affecting(config: Config) -> dict[str, Any]:
    """Select the values that affect the bytes of a dataset: all but how fast models are asked."""
    return config.model_dump(mode="json", exclude=set(RUNTIME_SECTIONS))


def fingerprint_tree(tree: Mapping[str, Any]) -> str:
    """Hash a configuration as run.json holds it, as `fingerprint_config` does."""
    text = json.dumps(tree, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def list_keys() -> dict[str, dict[str, Any]]:
    """List the JSON schema of every key (`type`, bounds, `enum`, `default`, `description`) by dotted name, in order."""
    schema = Config.model_json_schema()
    keys = {}
    for section, reference in schema["properties"].items():
        for name, field in schema["$defs"][_resolve_definition(reference)]["properties"].items():
            keys[f"{section}.{name}"] = field
    return keys


def format_commented_yaml(config: Config | None = None) -> str:
    """Format a configuration, by default the default one, as YAML with meaning and bounds of each key as comments."""
    lines = [
        "# Every key there is, with its meaning, its bounds and its default; a key that is deleted has its default.",
        "# tableverse build … --config FILE, or one key alone: --set run.seed=7",
    ]
    schema, values = Config.model_json_schema(), (config or Config()).model_dump(mode="json")
    for section, reference in schema["properties"].items():
        definition = schema["$defs"][_resolve_definition(reference)]
        lines += ["", *_format_comment(definition.get("description", ""), ""), f"{section}:"]
        for name, field in definition["properties"].items():
            lines += _format_comment(field.get("description", ""), "  ")
            value, default = json.dumps(values[section][name]), json.dumps(field.get("default"))
            lines.append(f"  {name}: {value}  # {describe_allowed_values(field)}; default {default}")
    return "\n".join(lines) + "\n"


def describe_allowed_values(field: Mapping[str, Any]) -> str:
    """Describe what a key allows, from its JSON schema: `a number, at least 0`."""
    if "anyOf" in field:
        return " or ".join(describe_allowed_values(option) for option in field["anyOf"])
    if "const" in field:
        return f"only {field['const']}"
    if "enum" in field:
        return "one of " + ", ".join(str(choice) for choice in field["enum"])
    kinds = {"number": "a number", "integer": "a whole number", "boolean": "true or false", "string": "text"}
    if field.get("type") == "array":
        return _describe_list(field)
    words = [kinds.get(field.get("type", ""), "null")]
    words += [f"that matches {field['pattern']}"] if "pattern" in field else []
    words += [f"{word} {field[bound]:.15g}" for bound, word in _BOUNDS.items() if bound in field]
    return ", ".join(words)


def _describe_list(field: Mapping[str, Any]) -> str:
    """Describe a list by how many values it may have and what each is: `a list of 2, each a number, more than 0`."""
    least, most = field.get("minItems", 0), field.get("maxItems", "any number")
    count = f"{most}" if least == most else f"{least} to {most}"
    return f"a list of {count}, each {describe_allowed_values(_find_item(field, 0))}"


def _find_item(field: Mapping[str, Any], index: int) -> Mapping[str, Any]:
    """Find the schema of a value of a list, by its index."""
    found: Mapping[str, Any] = field["prefixItems"][index] if "prefixItems" in field else field["items"]
    return found


def load_yaml(path: Path) -> dict[str, Any]:
    """Load sections with keys from a small YAML file; sections without any key are left out."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{path}: more than {MAX_FILE_BYTES} bytes: a configuration file is small")
    try:
        tree = yaml.load(data, _StrictLoader)  # noqa: S506 a SafeLoader with less
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, *_TAG_ERRORS) as error:
        raise ConfigError(f"{path}: not valid YAML: {_describe_yaml_error(error)}") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: a {type(tree).__name__} stands at the top; give sections with keys")
    return {section: keys for section, keys in tree.items() if keys is not None}  # all of its keys commented out


def _parse_override(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or key.count(".") != 1:
        raise ConfigError(
            f"{_OVERRIDE_PREFIX}{represent(text)}: write it as section.key=value, e.g. rectify.clearance_m=0.001"
        )
    try:
        return key, yaml.load(value, _StrictLoader)  # noqa: S506 a SafeLoader with less
    except (yaml.YAMLError, RecursionError, *_TAG_ERRORS) as error:
        raise ConfigError(
            f"{_OVERRIDE_PREFIX}{key}: {represent(value)} is no YAML value: {_describe_yaml_error(error)}"
        ) from None


def _describe_yaml_error(error: Exception) -> str:
    """Describe in one line what YAML refuses; of long integers Python says how its limit is raised."""
    text = " ".join(str(error).split())[:300]
    return "an integer of thousands of digits" if "set_int_max_str_digits" in str(error) else text


def _set_key(tree: dict[str, Any], key: str, value: Any) -> None:
    section, name = key.split(".")
    inside = tree.get(section)
    if inside is not None and not isinstance(inside, dict):
        raise ConfigError(
            f"{_OVERRIDE_PREFIX}{section}: {represent(inside)} is no section; "
            f"give keys, e.g. {_format_example(section)}"
        )
    tree[section] = {**(inside or {}), name: value}


def _is_overridden(location: tuple[int | str, ...], changed: set[str]) -> bool:
    place = ".".join(str(part) for part in location[:2])
    return any(key == place or key.startswith(f"{place}.") or not place for key in changed)


def _explain(error: Mapping[str, Any]) -> tuple[str, str]:
    """Explain a problem: what is wrong, and the remedy, which may be empty."""
    location, value, message = error["loc"], error["input"], error["msg"]
    key = ".".join(str(part) for part in location[:2])
    known = list_keys()
    if error["type"] == "value_error":  # our own message; the value may be a secret
        return f"{key}: {error['ctx']['error']}" if key else str(error["ctx"]["error"]), ""
    if key in known:
        field: Mapping[str, Any] = known[key]
        index = next((part for part in location[2:] if isinstance(part, int)), None)
        if index is not None and error["type"] != "missing":  # one value of a list; one that is missing is the list's
            key, field = f"{key}.{index}", _find_item(field, index)
        return f"{key}: {represent(value)} is not allowed; give {describe_allowed_values(field)}", ""
    sections = [*Config.model_fields]
    if len(location) == 1 and key in sections:
        return f"{key}: {represent(value)} is no section; give keys, e.g. {_format_example(key)}", ""
    if not all(isinstance(part, str) for part in location):
        return f"{represent(key)}: {message}", ""
    return f"unknown key {represent(key)}", _suggest_key(key, list(known))


def _suggest_key(key: str, known: list[str]) -> str:
    """Suggest the closest key of the named section, else of any section, else list what there is."""
    section, _, name = key.partition(".")
    siblings = [k for k in known if k.startswith(f"{section}.")]
    for candidates, cutoff in ((siblings, 0.6), (known, 0.75)):
        by_name = {k.partition(".")[2]: k for k in reversed(candidates)}
        if close := difflib.get_close_matches(name or section, by_name, n=1, cutoff=cutoff):
            return f"did you mean {by_name[close[0]]}?"
    if siblings:
        return f"{section} has {', '.join(k.partition('.')[2] for k in siblings)}"
    close = difflib.get_close_matches(section, Config.model_fields, n=1)
    return f"did you mean the section {close[0]}?" if close else f"sections are {', '.join(Config.model_fields)}"


def _format_example(section: str) -> str:
    return next((f"{key}={field.get('default')}" for key, field in list_keys().items() if key.startswith(section)), "")


def _resolve_definition(reference: Mapping[str, Any]) -> str:
    target = reference.get("$ref") or reference["allOf"][0]["$ref"]
    return str(target).rpartition("/")[2]


def _format_comment(text: str, indent: str) -> Iterator[str]:
    return (f"{indent}# {line.strip()}" for line in text.splitlines() if line.strip())
