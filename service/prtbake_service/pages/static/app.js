// The page of jobs.  All text goes in as text, never as markup.

import { Api, ApiError } from "/static/api.js";
import { drawFrontier } from "/static/frontier.js";

const REFRESH_MS = 2000;
const TERMINAL = new Set(["succeeded", "failed", "canceled", "expired"]);
const RETRYABLE = new Set(["failed", "canceled", "expired"]);
const KEY = "prtbake-key";

const byId = (id) => document.getElementById(id);
const cards = new Map(); // job id -> {element, version, preview}
let api = null;
let older = null; // cursor of the next page
let shownOlder = false;
let timer = 0;

function say(text) { byId("message").textContent = text; }

// A key in the fragment comes from `prtbake serve`: keep it for this tab, take it out of the URL.
function takeKey() {
  const given = new URLSearchParams(location.hash.slice(1)).get("key");
  if (given) {
    sessionStorage.setItem(KEY, given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem(KEY);
}

function size(bytes) {
  const units = ["B", "KiB", "MiB", "GiB"];
  let place = 0;
  let value = bytes;
  while (value >= 1024 && place < units.length - 1) { value /= 1024; place += 1; }
  return `${value.toFixed(place && value < 10 ? 1 : 0)} ${units[place]}`;
}

function duration(seconds) {
  if (seconds < 60) return `${seconds.toFixed(0)} s`;
  return `${Math.floor(seconds / 60)} min ${(seconds % 60).toFixed(0)} s`;
}

function stageLine(job) {
  const p = job.progress;
  if (job.state === "queued") return "waiting for a worker";
  const parts = [];
  if (p.stage) parts.push(`${p.stage} (${p.stage_index + 1} of ${p.stage_count})`);
  if (p.total && !TERMINAL.has(job.state)) parts.push(`${Math.round(p.done)} of ${Math.round(p.total)} ${p.unit}`);
  if (p.elapsed_s) parts.push(duration(p.elapsed_s));
  if (p.eta_s !== null && !TERMINAL.has(job.state)) parts.push(`about ${duration(p.eta_s)} left`);
  return parts.join(" · ");
}

async function save(jobId, artefact) {
  const blob = await api.artefact(jobId, artefact.name);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = artefact.name;
  link.click();
  URL.revokeObjectURL(link.href);
}

async function showPreview(card, job) {
  const picture = job.artefacts.find((a) => a.media_type === "image/png" && a.name.includes("preview"))
    ?? job.artefacts.find((a) => a.media_type === "image/png");
  if (!picture || card.preview === picture.sha256) return;
  card.preview = picture.sha256;
  const image = card.element.querySelector(".preview");
  image.src = URL.createObjectURL(await api.artefact(job.id, picture.name));
  image.alt = `Preview of ${job.label ?? job.id}`;
  image.hidden = false;
}

// A study's file never changes: it is read once, when its plot is first opened.
async function showFrontier(details, jobId) {
  const plot = details.querySelector(".plot");
  if (plot.childElementCount) return;
  drawFrontier(plot, JSON.parse(await (await api.artefact(jobId, "study.json")).text()));
}

function attempt(action) {
  return async () => {
    try { await action(); } catch (error) { fail(error); return; }
    refresh();
  };
}

function makeCard(job) {
  const element = byId("job-template").content.firstElementChild.cloneNode(true);
  element.querySelector(".cancel").onclick = attempt(() => api.cancel(job.id));
  element.querySelector(".retry").onclick = attempt(() => api.retry(job.id));
  const plot = element.querySelector(".study");
  plot.ontoggle = () => { if (plot.open) showFrontier(plot, job.id).catch(fail); };
  return { element, version: "", preview: null };
}

function fill(card, job) {
  const version = JSON.stringify(job);
  if (card.version === version) return;
  card.version = version;
  const part = (name) => card.element.querySelector(name);
  part(".label").textContent = job.label ?? job.kind;
  part(".state").textContent = job.state;
  part(".state").dataset.state = job.state;
  part(".id").textContent = job.id;
  part(".kind").textContent = job.kind;
  part("time").textContent = new Date(job.created).toLocaleString();
  part("time").dateTime = job.created;
  part("progress").value = job.progress.fraction;
  part("progress").hidden = TERMINAL.has(job.state);
  part(".stage").textContent = stageLine(job);
  part(".error").hidden = !job.error;
  part(".error").textContent = job.error ? `${job.error.detail} [${job.error.code}]` : "";
  part(".cancel").hidden = TERMINAL.has(job.state) || job.state === "cancel_requested";
  part(".retry").hidden = !RETRYABLE.has(job.state);
  part(".study").hidden = !job.artefacts.some((artefact) => artefact.name === "study.json");
  part(".left").hidden = job.artefacts.length === 0;
  part(".files").replaceChildren(...job.artefacts.map((artefact) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    button.textContent = artefact.name;
    button.onclick = attempt(() => save(job.id, artefact));
    item.append(button, ` ${size(artefact.size)}`);
    return item;
  }));
  showPreview(card, job).catch(fail);
}

function show(jobs, { append }) {
  const list = byId("jobs");
  const elements = jobs.map((job) => {
    let card = cards.get(job.id);
    if (!card) { card = makeCard(job); cards.set(job.id, card); }
    fill(card, job);
    return card.element;
  });
  if (append) { list.append(...elements); return; }
  const shown = new Set(elements);
  const rest = shownOlder ? [...list.children].filter((element) => !shown.has(element)) : [];
  list.replaceChildren(...elements, ...rest);
}

function fail(error) {
  if (error instanceof ApiError && error.status === 401) {
    sessionStorage.removeItem(KEY);
    api = null;
    askForKey();
  }
  say(error.message);
}

async function refresh() {
  clearTimeout(timer);
  if (!api) return;
  try {
    const page = await api.jobs({ state: byId("state").value });
    show(page.items, { append: false });
    if (!shownOlder) older = page.next;
    byId("more").hidden = older === null;
    say(page.items.length ? "" : "No jobs here: submit one with `prtbake submit`.");
  } catch (error) { fail(error); }
  // a page that nobody sees asks for nothing
  if (api && !document.hidden) timer = setTimeout(refresh, REFRESH_MS);
}

function askForKey() {
  byId("key-form").hidden = false;
  byId("filters").hidden = true;
  byId("jobs").replaceChildren();
  say("Enter an API key; `prtbake serve` prints a link that carries one.");
}

function open(key) {
  api = new Api(key);
  byId("key-form").hidden = true;
  byId("filters").hidden = false;
  refresh();
}

byId("key-form").onsubmit = (event) => {
  event.preventDefault();
  sessionStorage.setItem(KEY, byId("key").value);
  open(byId("key").value);
};
byId("state").onchange = () => { shownOlder = false; refresh(); };
byId("more").onclick = attempt(async () => {
  const page = await api.jobs({ state: byId("state").value, cursor: older });
  show(page.items, { append: true });
  shownOlder = true;
  older = page.next;
});
document.addEventListener("visibilitychange", () => { if (!document.hidden) refresh(); });

const key = takeKey();
if (key) open(key); else askForKey();
