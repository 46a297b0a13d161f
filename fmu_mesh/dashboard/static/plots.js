// Draws the curves of the page. It asks for what has changed, draws it, and only then asks again: so a browser that is
// slow or asleep asks less often or not at all, and the server keeps nothing for it.
"use strict";

window.fmuMeshPlots = (() => {
  const LEAST_MS = 50; // 20 pictures per second
  const SHARE = 2; // of the time between two pictures, at most a third is drawing
  const AGAIN_MS = 1000;
  const plots = new Map(); // by the id of a chart: {names, drawn}
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
    change.at.forEach((at, i) => {
      const low = [change.tl[i], change.l[i]];
      const high = [change.th[i], change.h[i]];
      curve.cells.set(at, low[0] === high[0] ? [low] : low[0] < high[0] ? [low, high] : [high, low]);
    });
    curve.points = [...curve.cells.keys()].sort((a, b) => a - b).flatMap((at) => curve.cells.get(at));
    if (shown > 0 && curve.points.length > 0) {
      const from = curve.points[curve.points.length - 1][0] - shown;
      for (const [at, cell] of curve.cells) if (cell[cell.length - 1][0] < from) curve.cells.delete(at);
      curve.points = curve.points.filter((point) => point[0] >= from);
    }
  }

  function draw(changed) {
    for (const [id, one] of plots) {
      const chart = getElement(id)?.chart;
      if (!chart) continue;
      if (one.names.some((name) => changed.has(name))) one.drawn = false;
      if (one.drawn || !isOnScreen(chart.getDom())) continue;
      const series = one.names.map((name) => ({ data: curves.get(name)?.points ?? [] }));
      const ends = series.filter((own) => own.data.length).map((own) => own.data[own.data.length - 1][0]);
      const last = Math.max(...ends);
      const from = shown > 0 && ends.length ? last - shown : "dataMin";
      const to = ends.length ? last : "dataMax";
      chart.setOption({ xAxis: { min: from, max: to }, series }, { lazyUpdate: true });
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
