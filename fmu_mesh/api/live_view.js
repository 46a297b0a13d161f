// Draws what `LiveView` sends: one plot for each unit, all over the same time, in the colours of the page around it.
const COLOURS = ["#2583cf", "#d9730d", "#2e9e5b", "#b44fa8", "#a08a00", "#d64545", "#7d74dd", "#2b9aa8", "#a5724a", "#8a8f96"];
const [WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [760, 180, 64, 12, 10, 22];

function add(parent, name, attributes, text = "") {
  const space = ["div", "span"].includes(name) ? "http://www.w3.org/1999/xhtml" : "http://www.w3.org/2000/svg";
  const element = document.createElementNS(space, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.textContent = text; // names are data, never markup
  return parent.appendChild(element);
}

function rows(curve) {
  const { buffer, byteOffset, byteLength } = curve.points;
  const numbers = new Float64Array(buffer.slice(byteOffset, byteOffset + byteLength));
  return { ...curve, times: numbers.slice(0, numbers.length / 2), values: numbers.slice(numbers.length / 2) };
}

function ends(lists) {
  let [low, high] = [Infinity, -Infinity];
  for (const list of lists) for (const x of list) if (x === x) [low, high] = [Math.min(low, x), Math.max(high, x)];
  if (low > high) return [0, 1];
  return low < high ? [low, high] : [low - 0.5, high + 0.5];
}

function short(x, span) {
  const decimals = 2 - Math.floor(Math.log10(span)); // so that the ends of a narrow axis differ
  return String(Number(decimals >= 0 && decimals < 12 ? x.toFixed(decimals) : x.toPrecision(6)));
}

function plot(el, curves, [from, to]) {
  const [low, high] = ends(curves.map((curve) => curve.values));
  const x = (time) => LEFT + ((time - from) / (to - from)) * (WIDTH - LEFT - RIGHT);
  const y = (value) => HEIGHT - BOTTOM - ((value - low) / (high - low)) * (HEIGHT - TOP - BOTTOM);
  const legend = add(el, "div", { style: "font-size: 12px; padding-left: 64px" });
  const style = "width: 100%; max-width: 760px; display: block; font: 11px sans-serif";
  const svg = add(el, "svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, style, fill: "currentColor" });
  for (const value of [low, (low + high) / 2, high]) {
    const at = y(value);
    add(svg, "path", { d: `M${LEFT} ${at}H${WIDTH - RIGHT}`, stroke: "currentColor", opacity: 0.25 });
    add(svg, "text", { x: LEFT - 6, y: at + 4, "text-anchor": "end" }, short(value, high - low));
  }
  for (const [time, anchor] of [[from, "start"], [(from + to) / 2, "middle"], [to, "end"]])
    add(svg, "text", { x: x(time), y: HEIGHT - 6, "text-anchor": anchor }, `${short(time, to - from)} s`);
  for (const { name, unit, held, now, times, values, colour } of curves) {
    let d = "";
    values.forEach((value, i) => {
      if (value !== value) return;
      const begins = i === 0 || values[i - 1] !== values[i - 1];
      d += begins ? `M${x(times[i])} ${y(value)}` : held ? `H${x(times[i])}V${y(value)}` : `L${x(times[i])} ${y(value)}`;
    });
    add(svg, "path", { d, fill: "none", stroke: colour, "stroke-width": 1.6, "stroke-linecap": "round" });
        add(legend, "span", { style: `color: ${colour}` }, "\u25a0 ");
    add(legend, "span", { style: "margin-right: 1.5em" }, now ? `${name} = ${now} ${unit}` : name);
  }
}

function render({ model, el }) {
  const draw = () => {
    const curves = model.get("curves").map((curve, i) => ({ ...rows(curve), colour: COLOURS[i % COLOURS.length] }));
    const span = ends(curves.map((curve) => curve.times));
    el.replaceChildren();
    add(el, "div", { style: "font-size: 12px; opacity: 0.75" }, model.get("state"));
    for (const unit of new Set(curves.map((curve) => curve.unit)))
      plot(el, curves.filter((curve) => curve.unit === unit), span);
  };
  model.on("change:curves change:state", draw);
  draw();
  return () => model.off("change:curves change:state", draw);
}

export default { render };
