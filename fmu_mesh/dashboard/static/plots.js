// Draws the curves of the page. It asks for what has changed, draws it, and only then asks again: so a browser that is
// slow or asleep asks less often or not at all, and the server keeps nothing for it.
"use strict";

window.fmuMeshPlots = (() => {
  const LEAST_MS = 50; // 20 pictures per second
  const SHARE = 2; // of the time between two pictures, at most a third is drawing
  const AGAIN_MS = 1000;
  const COLORS = {
    // On white and on the dark card, each is at least 3 : 1; neighbours are told apart by the colour-blind as well.
    default: ["#0072b2", "#d55e00", "#00805d", "#b5508a", "#a87400", "#3a8fc7", "#000000", "#777777"],
    dark: ["#56b4e9", "#ff8c42", "#2ccc9a", "#e59ac6", "#f0c445", "#a9b4ff", "#ffffff", "#a0a0a0"],
  };
  const plots = new Map(); // by the id of a chart: {names, drawn, theme}
  const curves = new Map(); // by name: {version, cells}, and cells by the number of an interval
  let shown = 0; // the last so many seconds; 0: from the start on
  let mesh = null;
  let run = 0;
  let going = false;

  function show(key, number) {
    if (key !== mesh || number !== run) curves.clear();
    mesh = key;
    run = number;
    plots.clear();
    if (!going) {
      going = true;
      live();
    }
  }

  function plot(id, names) {
    plots.set(id, { names, drawn: false });
  }

  function span(seconds) {
    shown = seconds;
    curves.clear();
  }

  function drop(id) {
    plots.delete(id);
  }

  async function live() {
    for (;;) {
      const began = performance.now();
      let pause = LEAST_MS;
      try {
        const changed = await ask();
        const drawing = performance.now();
        draw(changed);
        pause = Math.max(LEAST_MS - (drawing - began), SHARE * (performance.now() - drawing));
      } catch (error) {
        pause = AGAIN_MS;
      }
      await new Promise((resolve) => setTimeout(resolve, Math.max(0, pause)));
      while (document.hidden) await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
  }

  async function ask() {
    const names = new Set([...plots.values()].flatMap((one) => one.names));
    for (const name of curves.keys()) if (!names.has(name)) curves.delete(name);
    if (mesh === null || names.size === 0) return new Set();
    const asked = { mesh, run, curves: {}, span: shown };
    for (const name of names) asked.curves[name] = curves.get(name)?.version ?? 0;
    const answer = await fetch("/dashboard/curves", { method: "POST", body: JSON.stringify(asked) });
    if (!answer.ok) throw new Error(`${answer.status}`);
    const changes = await answer.json();
    if (asked.mesh !== mesh || asked.run !== run || asked.span !== shown) return new Set(); // the page shows another mesh by now
    for (const [name, change] of Object.entries(changes)) take(name, change);
    return new Set(Object.keys(changes));
  }

  function take(name, change) {
    let curve = curves.get(name);
    if (curve === undefined || change.whole) {
      curve = { cells: new Map() };
      curves.set(name, curve);
    }
    curve.version = change.version;
    const gaps = new Set(change.g);
    change.at.forEach((at, i) => {
      const low = [change.tl[i], change.l[i]];
      const high = [change.th[i], change.h[i]];
      const points = low[0] === high[0] ? [low] : low[0] < high[0] ? [low, high] : [high, low];
      curve.cells.set(at, { points, isCut: gaps.has(at) });
    });
    const cells = [...curve.cells.entries()].sort((a, b) => a[0] - b[0]);
    const from = shown > 0 && cells.length > 0 ? cells.at(-1)[1].points.at(-1)[0] - shown : -Infinity;
    curve.points = []; // values only
    curve.line = []; // what is drawn: nothing leads over a time of which nothing is known
    let length = 0;
    for (const [at, cell] of cells) {
      const points = cell.points.filter((point) => point[0] >= from);
      if (points.length === 0) curve.cells.delete(at);
      curve.points.push(...points);
      curve.line.push(...points);
      length += points.length;
      if (!cell.isCut || length === 0) continue;
      const last = curve.points.at(-1);
      if (length === 1) curve.line.splice(-1, 1, { value: last, symbol: "circle" }); // a line of one point is invisible
      curve.line.push([last[0], null]);
      length = 0;
    }
  }

  function draw(changed) {
    for (const [id, one] of plots) {
      const chart = getElement(id)?.chart;
      if (!chart) continue;
      const theme = document.body.classList.contains("body--dark") ? "dark" : "default";
      if (one.theme !== theme || one.names.some((name) => changed.has(name))) one.drawn = false;
      if (one.drawn || !isOnScreen(chart.getDom())) continue;
      if (one.theme !== theme) chart.setTheme(theme);
      one.theme = theme;
      const found = one.names.map((name) => curves.get(name) ?? { points: [], line: [] });
      const series = found.map((own) => {
        const hasDots = own.line.some((point) => point.symbol);
        return { data: own.line, showSymbol: hasDots, symbol: hasDots ? "none" : "circle" };
      });
      const ends = found.filter((own) => own.points.length).map((own) => own.points.at(-1)[0]);
      const last = Math.max(...ends);
      const from = shown > 0 && ends.length ? last - shown : "dataMin";
      const to = ends.length ? last : "dataMax";
      const colors = { color: COLORS[theme], backgroundColor: "transparent" };
      chart.setOption({ ...colors, xAxis: { min: from, max: to }, series }, { lazyUpdate: true });
      one.drawn = true;
      window.fmuMeshPlots.pictures += 1;
    }
  }

  function isOnScreen(element) {
    const place = element.getBoundingClientRect();
    return place.bottom > 0 && place.top < window.innerHeight;
  }

  return { show, plot, span, drop, pictures: 0, curves };
})();
