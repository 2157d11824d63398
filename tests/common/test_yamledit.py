"""Values of YAML files changed in place: all other lines stay to the byte."""

import pytest
import yaml

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.yamlfile import edited

TEXT = """\
# head
site: lake_wheeler  # own?
antennas: {uav: lake_wheeler/dataset12_uav}  # learned
rt: {attitude: logged, max_depth: 2}  # quick
link:
  # of the tower
  rss:
    carrier_hz: 3.3e9  # GHz
    uav:
      antenna:
        model: sphere
        file: a.csv
      # stays
  channels: {A: {uav: {antenna: {model: iso}}}}
rss:
  field: power   # why

# end
"""


def test_other_lines_stay_and_each_style_of_value_is_changed() -> None:
    new = edited(TEXT, {
        ("rt", "max_depth"): 0, ("rt", "foliage"): "none", ("rss", "field"): "coherent", ("rss", "window_s"): 1.5,
        ("site",): {"file": "lake_wheeler", "without_buildings": True},
        ("link", "rss", "uav", "antenna"): {"model": "iso"}, ("report", "export"): ["netcdf"],
    })  # fmt: skip
    assert (
        new
        == """\
# head
site: {file: lake_wheeler, without_buildings: true}  # own?
antennas: {uav: lake_wheeler/dataset12_uav}  # learned
rt: {attitude: logged, max_depth: 0, foliage: none}  # quick
link:
  # of the tower
  rss:
    carrier_hz: 3.3e9  # GHz
    uav:
      antenna:
        {model: iso}
      # stays
  channels: {A: {uav: {antenna: {model: iso}}}}
rss:
  window_s: 1.5
  field: coherent   # why

# end
report: {export: [netcdf]}
"""
    )


@pytest.mark.parametrize("path", [
    ("site",), ("antennas",), ("rt", "attitude"), ("rt", "max_depth"), ("link", "rss", "uav", "antenna"),
    ("link", "channels"), ("rss", "field"), ("link", "rss", "carrier_hz"),
])  # fmt: skip
def test_a_key_goes_with_its_lines_alone(path: tuple[str, ...]) -> None:
    new = edited(TEXT, {path: None})
    content = yaml.safe_load(new)
    for key in path[:-1]:
        content = content[key]
    assert path[-1] not in content
    assert [line for line in new.splitlines() if line.lstrip().startswith("#")] == [
        line for line in TEXT.splitlines() if line.lstrip().startswith("#")
    ]
    assert len(set(TEXT.splitlines()) - set(new.splitlines())) <= 3


def test_what_is_not_there_cannot_go_and_shared_values_are_refused() -> None:
    assert edited(TEXT, {("rt", "diffraction"): None}) == TEXT
    assert edited("a: 1", {("b",): 2}) == "a: 1\nb: 2\n"
    with pytest.raises(UsageError, match=r"first\.depth cannot be changed alone"):
        edited("first: &both {depth: 1}\nsecond: *both\n", {("first", "depth"): 2})
