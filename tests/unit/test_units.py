"""Units: what converts into what, in which order a connection calculates, and what is refused."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.pictures.plan_page import plan_page
from fmu_mesh.variables.units import BaseUnit, Linear, conversion
from tests.fmus.helpers import find_fmu
from tests.fmus.packing import repacked
from tests.helpers import FMUS, write_config
from tests.planning import prepare

RAD = BaseUnit(rad=1)
DEG = BaseUnit(rad=1, factor=0.017453292519943295)
KELVIN = BaseUnit(K=1)
CELSIUS = BaseUnit(K=1, offset=273.15)
FAHRENHEIT = BaseUnit(K=1, factor=0.5555555555555556, offset=255.3722222222222)


@pytest.mark.parametrize(
    ("source", "target", "value", "expected"),
    [
        (BaseUnit(m=1), BaseUnit(m=1, factor=0.001), 1.5, 1500.0),
        (BaseUnit(m=1, factor=0.001), BaseUnit(m=1), 1500.0, 1.5),
        (DEG, RAD, 180.0, 3.141592653589793),
        (RAD, DEG, 1.0, 57.29577951308232),
        (KELVIN, CELSIUS, 300.0, 26.850000000000023),
        (CELSIUS, KELVIN, 20.0, 293.15),
        (FAHRENHEIT, CELSIUS, 212.0, pytest.approx(100.0, rel=1e-14)),  # 5/9 is no float
    ],
)
def test_a_value_is_converted_by_way_of_the_base_units(
    source: BaseUnit, target: BaseUnit, value: float, expected: float
) -> None:
    change = conversion(source, target)

    assert change is not None
    assert change.factor * value + change.offset == expected


def test_the_difference_of_two_temperatures_has_no_offset() -> None:
    assert conversion(CELSIUS, KELVIN, relative=True) == Linear()


def test_units_of_different_dimensions_do_not_convert() -> None:
    assert conversion(RAD, BaseUnit(m=1)) is None
    assert conversion(BaseUnit(s=-1), BaseUnit(s=-1, rad=1)) is None


@given(st.builds(BaseUnit, factor=st.floats(1e-30, 1e30), offset=st.floats(-1e30, 1e30)))
def test_a_unit_into_itself_is_no_operation_at_all(unit: BaseUnit) -> None:
    change = conversion(unit, unit)

    assert change is not None
    assert change.identity


@given(st.builds(Linear, st.floats(), st.floats()))
def test_nothing_before_or_after_a_calculation_leaves_every_bit_of_it(linear: Linear) -> None:
    assert linear.then(Linear()) is linear
    assert Linear().then(linear) is linear


def test_a_dimension_is_shown_in_base_units() -> None:
    assert str(BaseUnit(kg=1, m=2, s=-2)) == "kg.m2.s-2"
    assert str(BaseUnit(factor=0.01)) == "1"


@pytest.mark.parametrize("broken", [{"factor": 0.0}, {"factor": float("inf")}, {"offset": float("nan")}])
def test_a_unit_that_nothing_can_be_converted_with_is_known(broken: dict[str, float]) -> None:
    assert not BaseUnit(**broken).usable  # type: ignore[arg-type] # only the two floats are given


# ---- from the FMU to the plan


def gain_with_units(folder: Path, name: str, definitions: str, **units: str) -> Path:
    """A copy of Gain.fmu whose variables have these units."""
    path = folder / f"{name}.fmu"
    with zipfile.ZipFile(FMUS / "Gain.fmu") as source, zipfile.ZipFile(path, "w") as target:
        for entry in source.infolist():
            data = source.read(entry)
            if entry.filename == "modelDescription.xml":
                text = data.decode().replace(
                    "  <LogCategories>", f"  <UnitDefinitions>{definitions}</UnitDefinitions>\n  <LogCategories>"
                )
                for variable, unit in units.items():
                    head, name_, tail = text.partition(f'<ScalarVariable name="{variable}"')
                    text = head + name_ + tail.replace("<Real", f'<Real unit="{unit}"', 1)
                data = text.encode()
            target.writestr(entry, data)
    return path


DEGREES = '<Unit name="deg"><BaseUnit rad="1" factor="0.017453292519943295"/></Unit>'
METRES = '<Unit name="m"><BaseUnit m="1"/></Unit>'
CELSIUS_AND_KELVIN = '<Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit><Unit name="K"><BaseUnit K="1"/></Unit>'


def config(folder: Path, connection: object, definitions: str = DEGREES, **units: str) -> Path:
    fmu = gain_with_units(folder, "own", definitions, **units)
    instances = {"pendulum": {"fmu": "DampedPendulum"}, "gain": {"fmu": str(fmu)}}
    return write_config(folder, instances=instances, connections=[connection])  # type: ignore[list-item] # the long form


def connection_line(path: Path) -> str:
    page = plan_page(prepare(path))
    return page[page.index("Connections") + 1].strip()


def test_the_base_units_of_an_fmu_are_read(tmp_path: Path) -> None:
    description = read_description(gain_with_units(tmp_path, "own", DEGREES, u="deg"))

    variable = description.variable("u")
    assert variable is not None
    assert (variable.unit, variable.base_unit) == ("deg", DEG)
    assert description.problems == ()


def test_a_connection_converts_and_check_shows_it(tmp_path: Path) -> None:
    path = config(tmp_path, "pendulum.a -> gain.u", u="deg")

    [connection] = prepare(path).connections

    assert (connection.factor, connection.offset) == (57.29577951308232, 0.0)
    assert connection_line(path).endswith("u = 57.2957795131 * a  rad to deg")
    assert "Warnings" not in plan_page(prepare(path))


def test_factor_and_offset_apply_after_the_conversion(tmp_path: Path) -> None:
    long_form = {"from": "pendulum.a", "to": "gain.u", "factor": 2.0, "offset": -1.0}
    path = config(tmp_path, long_form, u="deg")

    [connection] = prepare(path).connections

    assert (connection.factor, connection.offset) == (2.0 * 57.29577951308232, -1.0)
    assert connection_line(path).endswith("u = 114.591559026 * a - 1  rad to deg, then factor 2 and offset -1")


def test_units_of_different_dimensions_are_refused_with_the_way_out(tmp_path: Path) -> None:
    path = config(tmp_path, "pendulum.a -> gain.u", METRES, u="m")

    with pytest.raises(ConfigurationError) as caught:
        prepare(path)

    [finding] = caught.value.findings
    assert finding.found == "pendulum.a -> gain.u connects the unit 'rad' (rad) to the unit 'm' (m)"
    assert finding.expected == "units of one dimension, or `ignore_units: true` on the connection"


def test_ignore_units_switches_it_off_for_one_connection(tmp_path: Path) -> None:
    path = config(tmp_path, {"from": "pendulum.a", "to": "gain.u", "ignore_units": True}, METRES, u="m")

    [connection] = prepare(path).connections

    assert (connection.factor, connection.offset) == (1.0, 0.0)
    assert connection_line(path).endswith("units ignored")
    assert "Warnings" not in plan_page(prepare(path))


def test_where_one_end_has_no_unit_nothing_is_converted_and_check_warns(tmp_path: Path) -> None:
    path = config(tmp_path, "pendulum.a -> gain.u", DEGREES)

    [connection] = prepare(path).connections

    assert (connection.factor, connection.offset) == (1.0, 0.0)
    assert connection_line(path).endswith("not converted: gain.u has no unit")


def test_where_unit_is_not_defined_nothing_is_converted_and_warning_says_so(tmp_path: Path) -> None:
    path = config(tmp_path, "pendulum.a -> gain.u", DEGREES, u="furlong")

    [warning] = prepare(path).system.warnings

    assert warning.found == (
        "pendulum.a -> gain.u connects the unit 'rad' to the unit 'furlong' and converts "
        "nothing, because there are no base units of gain.u: its model does not define 'furlong'"
    )
    assert warning.expected == "the same unit, a factor that converts it, or `ignore_units: true` if both are the same"


def test_units_of_fmi_1_are_names_and_its_display_units_convert_nothing(tmp_path: Path) -> None:
    """A display unit is for people: every value is in the unit itself (FMI 1.0, 3.3)."""

    def with_units(text: str) -> str:
        degrees = '<BaseUnit unit="deg"><DisplayUnitDefinition displayUnit="rad" gain="57.3"/></BaseUnit>'
        text = text.replace("  <DefaultExp", f"  <UnitDefinitions>{degrees}</UnitDefinitions>\n  <DefaultExp")
        return text.replace('<Real start="0"/>', '<Real start="0" unit="deg" displayUnit="rad"/>', 1)

    old = repacked(tmp_path / "old.fmu", source=find_fmu("AllTypes1", tmp_path), description=with_units)
    instances = {"pendulum": {"fmu": "DampedPendulum"}, "old": {"fmu": str(old)}}
    path = write_config(tmp_path, instances=instances, connections=["pendulum.a -> old.real_in"])

    plan = prepare(path)

    assert plan.system.instances["old"].description.problems == ()
    assert (plan.connections[0].factor, plan.connections[0].offset) == (1.0, 0.0)
    [warning] = plan.system.warnings
    assert warning.found == (
        "pendulum.a -> old.real_in connects the unit 'rad' to the unit 'deg' and converts nothing, because there are "
        "no base units of old.real_in: FMI 1.0 gives units a name only"
    )
    same = write_config(tmp_path, instances=instances, connections=["old.real_out -> old.real_in"])
    assert not any("connects the unit" in line for line in plan_page(prepare(same)))


def test_a_temperature_is_shifted_and_a_difference_is_not(tmp_path: Path) -> None:
    first = gain_with_units(tmp_path, "first", CELSIUS_AND_KELVIN, y="degC")
    second = gain_with_units(tmp_path, "second", CELSIUS_AND_KELVIN, u="K")
    types = '</UnitDefinitions><TypeDefinitions><SimpleType name="Difference"><Real unit="K" relativeQuantity="true"/>'
    definitions = f"{CELSIUS_AND_KELVIN}{types}</SimpleType></TypeDefinitions><UnitDefinitions>"
    third = gain_with_units(tmp_path, "third", definitions, u='K" declaredType="Difference')
    fourth = gain_with_units(tmp_path, "fourth", CELSIUS_AND_KELVIN, u='K" relativeQuantity="true')
    paths = {"a": first, "b": second, "c": third, "d": fourth}
    instances = {name: {"fmu": str(path)} for name, path in paths.items()}
    path = write_config(tmp_path, instances=instances, connections=["a.y -> b.u", "a.y -> c.u", "a.y -> d.u"])

    shifted, *differences = prepare(path).connections

    assert (shifted.factor, shifted.offset) == (1.0, 273.15)
    assert [(c.factor, c.offset) for c in differences] == [(1.0, 0.0), (1.0, 0.0)]
