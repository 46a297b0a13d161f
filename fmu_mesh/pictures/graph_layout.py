"""Where boxes and wires of a system graph lie: columns from left to right, folded into bands where they are many.

Owns the geometry; knows neither instances nor how anything is drawn. A wire that goes forward crosses columns through a
place of its own. One that goes back, or on to the next band, turns: it runs beside the columns and below the band. So
no wire crosses a box. Lengths are in pixels; y grows downwards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from ..system.graph import feedback_edges, topological_order

__all__ = ["INITIAL", "Arrangement", "Dot", "Wire", "arranged", "going_back"]

Dot = tuple[float, float]

_BETWEEN_COLUMNS, _BETWEEN_BOXES, _BETWEEN_WIRES = 50.0, 24.0, 12.0
_LANE, _LANES = 9.0, 240.0
"""Distance of wires beside each other, and the most room that all of them take."""
_SWEEPS = 6
_FEW_COLUMNS, _WIDE, _TALL = 5, 1.8, 620.0
"""Up to this number of columns are one band; how wide a picture is, compared with its height; how high a column is, if
nothing asks for more."""


class Wire(NamedTuple):
    """One wire."""

    source: str | None  # the box it begins at, on the right; None if it comes from the left border
    target: str | None  # the box it ends at, on the left; None if it goes to the right border
    source_y: float = 0.0  # how far its beginning lies below the upper edge of the box; `target_y` likewise
    target_y: float = 0.0
    delay: int = 0  # 0 or 1: of wires that form a cycle, one with a delay goes back


class Arrangement(NamedTuple):
    """Where everything lies."""

    width: float  # of all; `height` likewise
    height: float
    places: dict[str, Dot]  # the upper left corner of each box
    paths: list[list[Dot]]  # the corners of each wire. Between two of them that differ in x and in y, it is curved


class _Part(NamedTuple):
    """What has a place in a column: a box, or a wire that crosses the column."""

    name: object
    width: float = 0.0
    height: float = 0.0


class _End(NamedTuple):
    """Where a step of a wire begins or ends: so far below the upper edge of a part."""

    name: object
    y: float = 0.0


_Step = tuple[_End, _End]


INITIAL = -1
"""The delay of wires with values of parameters, which have no part in the steps."""


def going_back(names: Sequence[str], wires: Sequence[tuple[str, str, int]]) -> set[int]:
    """Numbers of the wires (source, target, delay) that go back: without them there is no cycle."""
    pairs = sorted(dict.fromkeys(wires), key=lambda wire: wire[2])
    back = {pairs[index] for index in feedback_edges(names, [(source, target, True) for source, target, _ in pairs])}
    return {number for number, wire in enumerate(wires) if wire in back}


def arranged(boxes: Mapping[str, Dot], wires: Sequence[Wire]) -> Arrangement:
    """Arrange boxes, given as width and height in the order of execution, by the wires between them.

    Depends on nothing but the arguments and their order. Many columns become several bands.
    """
    wired = {end for wire in wires for end in (wire.source, wire.target)}
    main = _Columns({name: size for name, size in boxes.items() if name in wired}, wires).arrangement()
    return _with_others(main, {name: size for name, size in boxes.items() if name not in wired})


class _Columns:
    """The boxes that have wires: first their columns, then the order in these, then all places."""

    def __init__(self, boxes: Mapping[str, Dot], wires: Sequence[Wire]) -> None:
        self._boxes, self._wires = boxes, wires
        inner = [n for n, wire in enumerate(wires) if wire.source is not None and wire.target is not None]
        between = [(str(wires[n].source), str(wires[n].target), wires[n].delay) for n in inner]
        self._back = {inner[place] for place in going_back([*boxes], between)}
        self._columns = self._in_columns()
        self._column = {part.name: number for number, column in enumerate(self._columns) for part in column}
        self._routes = [self._route(number) for number in range(len(wires))]
        self._widths = [max((part.width for part in column), default=0.0) for column in self._columns]
        self._bands = self._folded()
        steps = dict.fromkeys(step for route in self._routes for step in pairwise(route))
        self._curves = [step for step in steps if self._is_curve(step)]
        self._turns = [step for step in steps if not self._is_curve(step)]
        self._tops: dict[object, float] = {}
        self._lefts: list[float] = []
        self._width = self._height = 0.0

    def arrangement(self) -> Arrangement:
        self._sort()
        self._align()
        turns = self._turn_corners()
        lefts, width = self._lefts, self._width
        paths: list[list[Dot]] = []
        for wire, route in zip(self._wires, self._routes, strict=True):
            path = [(0.0, self._y(route[0]))] if wire.source is None else []
            for end, after in pairwise([*route, None]):
                assert end is not None  # only the last one is
                y, left = self._y(end), lefts[self._column[end.name]]
                right = left + self._widths[self._column[end.name]]
                if end is not route[0] or wire.source is None:
                    path.append((left, y))
                if after is not None or wire.target is None:
                    own = [left + self._boxes[end.name][0]] if isinstance(end.name, str) else []
                    path += [(x, y) for x in (*own, right)]
                if after is not None:
                    path += turns.get((end, after), ())
            paths.append([*path, (width, self._y(route[-1]))] if wire.target is None else path)
        places = {name: (lefts[self._column[name]], self._tops[name]) for name in self._boxes}
        return Arrangement(width, self._height, places, paths)

    # --- columns

    def _in_columns(self) -> list[list[_Part]]:
        """Each box right of what it depends on; a column that is too high becomes several."""
        forward = [
            (wire.source, wire.target)
            for number, wire in enumerate(self._wires)
            if number not in self._back and wire.source is not None and wire.target is not None
        ]
        sources: dict[str, list[str]] = {name: [] for name in self._boxes}
        targets: dict[str, list[str]] = {name: [] for name in self._boxes}
        for source, target in forward:
            sources[target].append(source)
            targets[source].append(target)
        layers: dict[str, int] = {}
        for name in topological_order([*self._boxes], forward):
            layers[name] = max((layers[source] + 1 for source in sources[name]), default=0)
        for name in self._boxes:  # what depends on nothing stands near what depends on it
            if not sources[name]:
                layers[name] = min((layers[target] - 1 for target in targets[name]), default=0)
        area = sum((width + _BETWEEN_COLUMNS) * (height + _BETWEEN_BOXES) for width, height in self._boxes.values())
        highest = max(_TALL, math.sqrt(area))
        columns: list[list[_Part]] = []
        for layer in sorted({*layers.values()}):
            room = -math.inf
            for name, (width, height) in self._boxes.items():
                if layers[name] == layer:
                    if height > room:
                        columns.append([])
                        room = max(highest, height)
                    columns[-1].append(_Part(name, width, height))
                    room -= height + _BETWEEN_BOXES
        first: list[list[_Part]] = [[]] if any(wire.source is None for wire in self._wires) else []
        last: list[list[_Part]] = [[]] if any(wire.target is None for wire in self._wires) else []
        return [*first, *columns, *last]

    def _route(self, number: int) -> list[_End]:
        """The ends of a wire, and between them its places in the columns that it crosses."""
        wire = self._wires[number]
        ends = [_End(wire.source, wire.source_y)] if wire.source is not None else []
        last = [_End(wire.target, wire.target_y)] if wire.target is not None else []
        if number in self._back:
            return ends + last
        first_column = self._column[wire.source] + 1 if wire.source is not None else 0
        last_column = self._column[wire.target] if wire.target is not None else len(self._columns)
        for column in range(first_column, last_column):
            # Wires from the same output share their places, unless they end at the border.
            shared = wire.source is not None and wire.target is not None
            crossing = (wire.source if shared else number, wire.source_y, column)
            if crossing not in self._column:
                self._column[crossing] = column
                self._columns[column].append(_Part(crossing))
            ends.append(_End(crossing))
        return ends + last

    def _folded(self) -> list[int]:
        """The band of each column: as many bands as give about the shape of a page."""
        count = len(self._columns)
        width = sum(self._widths) + count * _BETWEEN_COLUMNS
        height = max(map(_height_of, self._columns), default=0.0) + 2.0 * _BETWEEN_BOXES
        bands = 1
        while count > _FEW_COLUMNS * bands and width / bands > _WIDE * height * bands:
            bands += 1
        in_band = math.ceil(count / bands) or 1
        return [number // in_band for number in range(count)]

    def _is_curve(self, step: _Step) -> bool:
        """Whether a step goes straight to the next column of its band."""
        first, second = (self._column[end.name] for end in step)
        return second == first + 1 and self._bands[first] == self._bands[second]

    # --- places

    def _sort(self) -> None:
        """Sort each column by the places of its neighbours, so that few wires cross."""
        neighbours = self._neighbours()
        place = {part.name: n / len(column) for column in self._columns for n, part in enumerate(column)}

        def key(part: _Part) -> float:
            others = own.get(part.name, ())
            return sum(place[far.name] for far, _ in others) / len(others) if others else place[part.name]

        for sweep in range(_SWEEPS):
            own = neighbours[sweep % 2]
            for column in self._columns if sweep % 2 == 0 else self._columns[::-1]:
                column.sort(key=key)
                place |= {part.name: (number + 0.5) / len(column) for number, part in enumerate(column)}

    def _align(self) -> None:
        """Where each part begins, so that wires are as straight as the order allows; then one band below the other."""
        neighbours, tops = self._neighbours(), self._tops
        for column in self._columns:
            start = [-0.5 * _height_of(column)] * len(column)
            tops |= {part.name: top for part, top in zip(column, _spread(column, start), strict=True)}
        for sweep in range(_SWEEPS + 1):
            own = neighbours[sweep % 2]
            for column in self._columns if sweep % 2 == 0 else self._columns[::-1]:
                wanted = []
                for part in column:
                    steps = own.get(part.name, ())
                    there = [self._y(far) - near.y for far, near in steps]
                    wanted.append(sum(there) / len(there) if there else tops[part.name])
                tops |= {part.name: top for part, top in zip(column, _spread(column, wanted), strict=True)}

    def _neighbours(self) -> tuple[dict[object, list[_Step]], dict[object, list[_Step]]]:
        """By part: the curves to what is left of it, and to what is right of it, each as (far end, own end)."""
        left: dict[object, list[_Step]] = {}
        right: dict[object, list[_Step]] = {}
        for first, second in self._curves:
            left.setdefault(second.name, []).append((first, second))
            right.setdefault(first.name, []).append((second, first))
        return left, right

    def _y(self, end: _End) -> float:
        return self._tops[end.name] + end.y

    def _band(self, end: _End) -> int:
        return self._bands[self._column[end.name]]

    # --- turns

    def _turn_corners(self) -> dict[_Step, list[Dot]]:
        """The corners of each turn between its ends; sets where columns and bands lie.

        A turn leaves its column on the right, goes down to its track below the band, along this, and up or down to its
        target on the left of that column. Turns from the same output share their way as far as it is the same.
        """
        right, left = _Lanes(), _Lanes()
        tracks, margins = _Lanes(), _Lanes()
        # A lower output turns first, and further up: so these ways do not cross.
        for start, end in sorted(self._turns, key=lambda step: (self._column[step[0].name], -self._y(step[0]))):
            right.add(self._column[start.name], start)
            tracks.add(self._band(start), start)
            if self._band(end) < self._band(start):
                margins.add(0, start)
                tracks.add(self._band(end), start)
            left.add(self._column[end.name], start)
        self._set_lefts(left, right, margins)
        track_y = self._stack_bands(tracks)
        corners = {}
        for start, end in self._turns:
            column, column_after = self._column[start.name], self._column[end.name]
            band, band_after = self._band(start), self._band(end)
            x = self._lefts[column] + self._widths[column] + right.distance(column, start)
            # Going down to the next band, lanes are in the order of the tracks, going up in the opposite one.
            distance = left.distance(column_after, start, backwards=band_after > band)
            x_after = self._lefts[column_after] - distance
            way = [(x, self._y(start)), (x, track_y[band, start])]
            if band_after < band:
                margin = margins.distance(0, start)
                way += [(margin, track_y[band, start]), (margin, track_y[band_after, start])]
            level = way[-1][1]
            corners[start, end] = [*way, (x_after, level), (x_after, self._y(end))]
        return corners

    def _set_lefts(self, left: _Lanes, right: _Lanes, margins: _Lanes) -> None:
        x = 0.0
        for column, width in enumerate(self._widths):
            if column == 0 or self._bands[column] != self._bands[column - 1]:
                x = margins.room(0)
            else:
                x += _BETWEEN_COLUMNS
            x += left.room(column)
            self._lefts.append(x)
            x += width + right.room(column)
            self._width = max(self._width, x)

    def _stack_bands(self, tracks: _Lanes) -> dict[tuple[int, _End], float]:
        """Put one band below the other; returns where the tracks are."""
        y = 0.0
        track_y: dict[tuple[int, _End], float] = {}
        for band in sorted({*self._bands}):
            own = [part for column, of in zip(self._columns, self._bands, strict=True) if of == band for part in column]
            shift = y - min((self._tops[part.name] for part in own), default=0.0)
            for part in own:
                self._tops[part.name] += shift
            y = max((self._tops[part.name] + part.height for part in own), default=y)
            track_y |= {(band, end): y + tracks.distance(band, end) for end in tracks.of(band)}
            y += tracks.room(band)
            self._height = y
            y += _BETWEEN_BOXES
        return track_y


class _Lanes:
    """Wires beside each other, at several places."""

    def __init__(self) -> None:
        self._orders: dict[int, dict[_End, int]] = {}

    def add(self, place: int, end: _End) -> None:
        order = self.of(place)
        order.setdefault(end, len(order))

    def of(self, place: int) -> dict[_End, int]:
        return self._orders.setdefault(place, {})

    def room(self, place: int) -> float:
        count = len(self.of(place))
        return (count + 1) * self._step(place) if count else 0.0

    def distance(self, place: int, end: _End, *, backwards: bool = False) -> float:
        """How far one of them is from where the room begins."""
        order = self.of(place)
        return (len(order) - order[end] if backwards else order[end] + 1) * self._step(place)

    def _step(self, place: int) -> float:
        return min(_LANE, _LANES / (len(self.of(place)) + 1))


def _gap(first: _Part, second: _Part) -> float:
    return _BETWEEN_BOXES if first.height and second.height else _BETWEEN_WIRES


def _height_of(column: Sequence[_Part]) -> float:
    return sum(part.height for part in column) + sum(_gap(*pair) for pair in pairwise(column))


def _spread(column: Sequence[_Part], wanted: Sequence[float]) -> list[float]:
    """The places nearest to the wanted ones at which nothing overlaps (pool adjacent violators)."""
    offsets = [0.0]
    for first, second in pairwise(column):
        offsets.append(offsets[-1] + first.height + _gap(first, second))
    blocks: list[tuple[float, int]] = []  # the mean of the wanted places without offsets, and of how many parts
    for place, offset in zip(wanted, offsets, strict=False):
        mean, count = place - offset, 1
        while blocks and blocks[-1][0] > mean:
            before, many = blocks.pop()
            mean, count = (before * many + mean * count) / (many + count), many + count
        blocks.append((mean, count))
    means = [mean for mean, count in blocks for _ in range(count)]
    return [mean + offset for mean, offset in zip(means, offsets, strict=False)]


def _with_others(main: Arrangement, others: Mapping[str, Dot]) -> Arrangement:
    """Boxes without wires in rows below the others."""
    area = sum((width + _BETWEEN_BOXES) * (height + _BETWEEN_BOXES) for width, height in others.values())
    widest = max(main.width, math.sqrt(_WIDE * area), *(width for width, _ in others.values()), 0.0)
    places, x, row_height, total = dict(main.places), 0.0, 0.0, main.width
    y = main.height + (_BETWEEN_BOXES if main.places and others else 0.0)
    for name, (width, height) in others.items():
        if x and x + width > widest:
            x, y, row_height = 0.0, y + row_height + _BETWEEN_BOXES, 0.0
        places[name] = x, y
        total, row_height = max(total, x + width), max(row_height, height)
        x += width + _BETWEEN_BOXES
    return Arrangement(total, max(main.height, y + row_height), places, main.paths)
