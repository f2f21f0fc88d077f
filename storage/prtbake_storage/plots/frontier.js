// The points of a study (study.json): error against seconds or bytes, on logarithmic axes.
// All text goes in as text, never as markup; looks are attributes, which a strict policy lets be.

const SVG = "http://www.w3.org/2000/svg";
const WIDTH = 720;
const HEIGHT = 420;
const MARGIN = { left: 76, right: 20, top: 16, bottom: 52 };
const COLOURS = { frontier: "#d1592a", point: "#4a78c2", line: "#8888" };
// Within a decade, from coarse to fine: the coarsest that mark an axis at three places are taken.
const FACTORS = [
  [1], [1, 2, 5], [1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9],
  Array.from({ length: 45 }, (_, n) => 1 + n / 5), Array.from({ length: 180 }, (_, n) => 1 + n / 20),
];
const COSTS = { seconds: "seconds of work", bytes: "bytes of the file" };

export function number(value) { return String(Number(value.toPrecision(3))); }

export function percent(value) { return `${number(100 * value)} %`; }

export function seconds(value) { return value < 120 ? `${number(value)} s` : `${number(value / 60)} min`; }

export function bytes(value) {
  const units = ["B", "kB", "MB"];
  for (const unit of units) {
    if (value < 1000) return `${number(value)} ${unit}`;
    value /= 1000;
  }
  return `${number(value)} GB`;
}

const WRITE = { seconds, bytes, error: percent };

function make(name, attributes, text) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

// A logarithmic axis over the values above 0; 0 itself stands at its lower end.
export function logAxis(values, from, to) {
  const above = values.filter((value) => value > 0);
  let low = Math.log10(above.length ? Math.min(...above) : 1);
  let high = Math.log10(above.length ? Math.max(...above) : 1);
  const room = Math.max(0.05 * (high - low), 0.05);
  low -= above.length < values.length ? 4 * room : room;
  high += room;
  let ticks = [];
  for (const factors of FACTORS) {
    ticks = [];
    for (let decade = Math.floor(low); decade <= Math.ceil(high); decade += 1) {
      for (const factor of factors) {
        const log = decade + Math.log10(factor);
        if (log >= low && log <= high) ticks.push(factor * 10 ** decade);
      }
    }
    if (ticks.length >= 3) break;
  }
  const place = (value) => from + (to - from) * ((value > 0 ? Math.log10(value) : low) - low) / (high - low);
  return { place, ticks };
}

// What there is to say of a point, a line each.
export function facts(point) {
  const noise = point.noise === null ? "" : ` (noise ${percent(point.noise)})`;
  const shared = point.shared_seconds > 0 ? `, ${seconds(point.shared_seconds)} of it shared` : "";
  return [
    `point ${point.point}`,
    ...Object.entries(point.values).map(([path, value]) => `${path} = ${JSON.stringify(value)}`),
    `error ${percent(point.error)}${noise}`,
    `${seconds(point.seconds)}${shared}`,
    `${bytes(point.bytes)} of ${point.file}`,
  ];
}

function plot(study, cost, tell) {
  const points = study.points.filter((point) => point.error !== null);
  const svg = make("svg", {
    viewBox: `0 0 ${WIDTH} ${HEIGHT}`, width: "100%", role: "group", fill: "currentColor",
    "font-family": "system-ui, sans-serif", "font-size": "12",
    "aria-label": `Error against ${COSTS[cost]} of ${points.length} points`,
  });
  const x = logAxis(points.map((point) => point[cost]), MARGIN.left, WIDTH - MARGIN.right);
  const y = logAxis(points.map((point) => point.error), HEIGHT - MARGIN.bottom, MARGIN.top);
  const bottom = HEIGHT - MARGIN.bottom;
  for (const tick of x.ticks) {
    const at = x.place(tick);
    svg.append(make("line", { x1: at, x2: at, y1: MARGIN.top, y2: bottom, stroke: COLOURS.line }));
    svg.append(make("text", { x: at, y: bottom + 18, "text-anchor": "middle" }, WRITE[cost](tick)));
  }
  for (const tick of y.ticks) {
    const at = y.place(tick);
    svg.append(make("line", { x1: MARGIN.left, x2: WIDTH - MARGIN.right, y1: at, y2: at, stroke: COLOURS.line }));
    svg.append(make("text", { x: MARGIN.left - 8, y: at + 4, "text-anchor": "end" }, percent(tick)));
  }
  svg.append(make("text", { x: (MARGIN.left + WIDTH) / 2, y: HEIGHT - 12, "text-anchor": "middle" }, COSTS[cost]));
  const middle = (MARGIN.top + bottom) / 2;
  svg.append(make("text", { x: 14, y: middle, "text-anchor": "middle", transform: `rotate(-90 14 ${middle})` }, "error"));
  const at = (point) => [x.place(point[cost]), y.place(point.error)];
  const byNumber = new Map(points.map((point) => [point.point, point]));
  const best = study.frontier[cost].map((name) => byNumber.get(name));
  svg.append(make("polyline", {
    points: best.map((point) => at(point).join(",")).join(" "), fill: "none", stroke: COLOURS.frontier, "stroke-width": 2,
  }));
  const on = new Set(best);
  for (const point of points) {
    const [cx, cy] = at(point);
    const radius = on.has(point) ? 6 : 5;
    const dot = make("circle", {
      cx, cy, r: radius, fill: on.has(point) ? COLOURS.frontier : COLOURS.point, "fill-opacity": 0.85,
      tabindex: 0, role: "img", "aria-label": facts(point).join(", "),
    });
    const show = () => { dot.setAttribute("r", radius + 3); tell(point); };
    const leave = () => { dot.setAttribute("r", radius); };
    dot.addEventListener("pointerenter", show);
    dot.addEventListener("pointerleave", leave);
    dot.addEventListener("focus", show);
    dot.addEventListener("blur", leave);
    svg.append(dot);
  }
  return svg;
}

export function drawFrontier(container, study) {
  const told = document.createElement("ul");
  told.setAttribute("aria-live", "polite");
  const tell = (point) => told.replaceChildren(...facts(point).map((fact) => {
    const item = document.createElement("li");
    item.textContent = fact;
    return item;
  }));
  const picture = document.createElement("div");
  const choice = document.createElement("p");
  for (const [place, cost] of Object.keys(COSTS).entries()) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `against ${COSTS[cost]}`;
    button.onclick = () => {
      for (const other of choice.children) other.setAttribute("aria-pressed", other === button);
      picture.replaceChildren(plot(study, cost, tell));
    };
    choice.append(button);
    if (place === 0) queueMicrotask(() => button.click());
  }
  const hint = document.createElement("li");
  hint.textContent = "Point at a dot, or step through them with the tab key: the orange ones are the frontier.";
  told.append(hint);
  container.replaceChildren(choice, picture, told);
}
