// The labelling page. A key changes what is shown at once and is saved behind; what could not be saved yet is kept in
// this browser, shown, and sent again until the server has it.

const $ = id => document.getElementById(id);
const style = getComputedStyle(document.documentElement); // read once: asking again makes the browser lay out the page
const COLOUR = Object.fromEntries(["line", "text", "dim", "safe", "fail", "guess"].map(name => [name, style.getPropertyValue(`--${name}`).trim()]));
const THUMBS = 16, AHEAD = 3, NEAR = 8, NEAR_AHEAD = 2, KEPT = 64, POLL_MS = 1500, SPEEDS = [0.25, 0.5, 1, 2, 4, 8];

let dataset, specification, entries = [], order = [], current = -1, frame = 0, changes = 0;
let playing = 0, speed = 2, margin = null, online = true;
const tab = sessionStorage.tab ??= crypto.randomUUID();

// -- talking to the server ---

async function call(path, body) {
  const options = body && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  const response = await fetch(`api/${path}`, options);
  if (!response.ok) {
    const text = await response.text();
    let message = text;
    try { message = JSON.parse(text).error ?? text; } catch { /* plain text */ }
    throw Object.assign(new Error(message), { status: response.status });
  }
  return response;
}
const read = async path => (await call(path)).json();

async function refresh() {
  const asked = specification;
  const news = await read(`labels/${asked}?since=${changes}`);
  if (asked !== specification) return;
  changes = news.changes;
  for (const entry of news.entries) adopt(entry);
  if (news.entries.length) { arrange(); showProgress(); }
}

function adopt(entry) {
  if (waiting.some(w => w.specification === specification && w.episode === entry.episode)) return;
  const before = entries[entry.episode];
  entries[entry.episode] = entry;
  showRow(entry.episode);
  if (entry.episode !== current) return;
  showVerdict();
  if (entry.guess !== undefined && before.guess === undefined) loadMargin(current);
}

async function poll() {
  try {
    await refresh();
    if (!online) { online = true; await start(); }
    await flush();
  } catch (error) { lost(error); }
  setTimeout(poll, POLL_MS);
}

function lost(error) {
  if (error.status === 409) return;
  online = error.status !== undefined && error.status !== 403;
  const kept = waiting.length ? ` ${waiting.length} label${waiting.length > 1 ? "s are" : " is"} kept in this browser and will be saved.` : "";
  const why = error.status === 403 ? "The server was restarted: open the address it printed." :
    error.status === undefined ? "The server does not answer: start latentsafe label again." : `Not saved: ${error.message}.`;
  $("banner").textContent = why + kept;
  $("banner").hidden = false;
  showSaved();
}

// -- saving: one label after the other, kept in the browser until the server has it ---

let waiting = [], flushing = null;
const shelf = () => `latentsafe ${dataset.identity} `;

function keep() {
  if (waiting.length) localStorage.setItem(shelf() + tab, JSON.stringify(waiting));
  else localStorage.removeItem(shelf() + tab);
  showSaved();
}

function takeOver() { // what an earlier page could not save
  for (const key of Object.keys(localStorage).filter(k => k.startsWith(shelf()))) {
    for (const item of JSON.parse(localStorage.getItem(key))) {
      if (dataset.specifications.includes(item.specification)) waiting.push(item);
    }
    localStorage.removeItem(key);
  }
  keep();
}

function save(episode, first) {
  const sent = waiting.find(w => w.specification === specification && w.episode === episode);
  if (sent && !sent.sending) sent.first = first;
  else waiting.push({ specification, episode, first, seen: sent ? null : entries[episode].at });
  keep();
  flush().catch(lost);
}

function flush() {
  flushing ??= send().finally(() => { flushing = null; });
  return flushing;
}

async function send() {
  while (waiting.length) {
    const item = waiting[0];
    item.sending = true;
    try {
      const { episode, first, seen } = item;
      const { entry } = await (await call(`labels/${item.specification}`, { episode, first, seen, tab })).json();
      done(item, entry);
    } catch (error) {
      item.sending = false;
      if (error.status !== 409 && error.status !== 400) throw error;
      done(item, null);
      toast(`Not saved: ${error.message}.`);
      await refreshAll();
    }
    $("banner").hidden = true;
  }
}

function done(item, entry) {
  waiting = waiting.filter(w => w !== item);
  for (const later of waiting) if (later.episode === item.episode && later.seen === null) later.seen = entry?.at ?? 0;
  keep();
  if (entry && item.specification === specification) adopt(entry);
}

async function undo() {
  await flush();
  const { entry } = await (await call(`undo/${specification}`, { tab })).json();
  if (!entry) return toast("Nothing to undo.");
  entries[entry.episode] = entry;
  showRow(entry.episode); showProgress();
  await open(entry.episode);
  toast(`Undone: episode ${entry.episode}.`);
}

// -- frames: a piece of an episode is fetched when it is shown or near, pictures are decoded when they are shown ---

const pieces = new Map(); // "episode:piece" -> promise of [camera][frame] blobs, the last used at the end
const pieceOf = index => Math.floor(index / dataset.piece);

function piece(episode, place) {
  const key = `${episode}:${place}`, range = `first=${place * dataset.piece}&count=${Math.min(dataset.piece, length(episode))}`;
  const found = pieces.get(key) ?? Promise.all(dataset.cameras.map((_, camera) => load(camera, episode, range)));
  found.catch(() => pieces.delete(key));
  pieces.delete(key);
  pieces.set(key, found);
  if (pieces.size > KEPT) pieces.delete(pieces.keys().next().value);
  return found;
}

async function pictures(episode, index) { // one blob a camera
  return (await piece(episode, pieceOf(index))).map(camera => camera[index % dataset.piece]);
}

async function load(camera, episode, asked) {
  const content = await (await call(`frames/${camera}/${episode}?${asked}`)).arrayBuffer();
  const sizes = new Uint32Array(content.slice(0, 4 * (1 + new DataView(content).getUint32(0, true))));
  let at = 4 * sizes.length;
  return Array.from(sizes.slice(1), size => new Blob([content.slice(at, at += size)]));
}

function missing(episode, index, far) { // the nearest piece that is not there yet; null: all are
  const here = pieceOf(index), last = pieceOf(length(episode) - 1);
  for (let off = 0; off <= far; off++) {
    for (const place of [here + off, here - off]) {
      if (place >= 0 && place <= last && !pieces.has(`${episode}:${place}`)) return [episode, place];
    }
  }
  return null;
}

function next() { // what to fetch while nothing is asked for: around the frame, then where the next episodes will open
  let wanted = missing(current, frame, NEAR), episode = current;
  for (let i = 0; i < AHEAD && !wanted; i++) {
    episode = nextOpen(episode);
    if (episode < 0) return null;
    wanted = missing(episode, opensAt(episode), NEAR_AHEAD);
  }
  return wanted;
}

let fetching = false;
async function fetchAhead() {
  if (fetching) return;
  fetching = true;
  try { for (let wanted; (wanted = next());) await piece(...wanted); } catch { /* asked for again when it is shown */ }
  fetching = false;
}

let wanted = 0, drawing = null;
function draw() { // one picture after the other, always the latest: what was passed over is not fetched
  wanted++;
  return drawing ??= drawLatest().finally(() => { drawing = null; });
}

async function drawLatest() {
  let mine;
  do {
    mine = wanted;
    try { await show(current, frame); } catch (error) { if (mine === wanted) throw error; }
  } while (mine !== wanted);
}

async function show(episode, index) {
  const images = await Promise.all((await pictures(episode, index)).map(blob => createImageBitmap(blob)));
  if (episode !== current) return;
  document.querySelectorAll("#cameras canvas").forEach((canvas, i) => {
    const { width, height } = images[i];
    if (canvas.width !== width || canvas.height !== height) {
      Object.assign(canvas, { width, height });
      canvas.classList.toggle("small", height <= 160);
      canvas.parentElement.style.setProperty("--shape", `${width} / ${height}`);
    }
    canvas.getContext("2d").drawImage(images[i], 0, 0);
    images[i].close();
  });
  $("view").dataset.shown = `${episode}:${index}`; // all cameras show the same frame of the same episode
}

// -- opening and ordering episodes ---

const length = episode => dataset.lengths[episode];
const opensAt = episode => Math.min(entries[episode].first ?? entries[episode].guess ?? 0, length(episode) - 1);
const isOpen = episode => entries[episode].first === null && !entries[episode].mixed;

function arrange() {
  const by = $("order").value, all = entries.map((_, episode) => episode);
  if (by !== "number") all.sort((a, b) => (entries[b][by] ?? -1) - (entries[a][by] ?? -1) || a - b);
  if (all.every((episode, i) => episode === order[i]) && $("episodes").childElementCount) return;
  order = all;
  const list = $("episodes");
  list.replaceChildren(...order.map(episode => rowOf(episode) ?? newRow(episode)));
}

function nextOpen(from) {
  const place = order.indexOf(from);
  for (let i = 1; i <= order.length; i++) {
    const episode = order[(place + i) % order.length];
    if (isOpen(episode) && episode !== from) return episode;
  }
  return -1;
}

async function open(episode) {
  if (episode < 0) return;
  stop();
  document.querySelector("#episodes [aria-current]")?.removeAttribute("aria-current");
  current = episode;
  margin = null;
  const row = rowOf(episode), entry = entries[episode];
  row.setAttribute("aria-current", "true");
  row.scrollIntoView({ block: "nearest" });
  frame = opensAt(episode);
  sessionStorage.episode = episode;
  $("view").dataset.episode = episode;
  document.querySelector("#title b").textContent = `Episode ${episode}`;
  $("task").textContent = dataset.tasks[episode];
  showVerdict();
  showFrame();
  draw().catch(() => {});
  $("film").getContext("2d").clearRect(0, 0, $("film").width, $("film").height);
  if (entry.guess !== undefined) loadMargin(episode);
  try {
    await pictures(episode, frame);
    if (current !== episode) return;
    await drawFilm(episode);
    fetchAhead();
  } catch (error) {
    if (error.status) toast(`Episode ${episode} cannot be shown: ${error.message}.`); else lost(error);
  }
}

async function loadMargin(episode) {
  const known = (await read(`margin/${episode}`).catch(() => ({}))).margin;
  if (current === episode) { margin = known; drawTimeline(); }
}

function mark(first) {
  const [episode, at] = ($("view").dataset.shown ?? "").split(":").map(Number);
  if (first !== null && (episode !== current || at !== frame)) return toast("Wait for the picture.");
  entries[current] = { ...entries[current], first, mixed: undefined, by: dataset.user };
  save(current, first);
  showRow(current); showProgress();
  const next = first === null ? -1 : nextOpen(current);
  if (next >= 0) open(next); else showVerdict();
  if (first !== null && next < 0) toast("Every episode is labelled.");
}

async function markFrame() { // this frame alone: what a constraint is made of
  const [episode, at] = ($("view").dataset.shown ?? "").split(":").map(Number);
  if (episode !== current || at !== frame) return toast("Wait for the picture.");
  await flush();
  const body = { episode, frame: at, seen: entries[episode].at, tab };
  const { entry } = await (await call(`marks/${specification}`, body)).json();
  entries[episode] = entry;
  showRow(episode); showProgress(); showVerdict();
  const n = entry.mixed?.filter(label => label === 1).length ?? 0;
  toast(`${n} frame${n === 1 ? "" : "s"} of this episode marked.`);
}

// -- showing ---

const rows = new Map();
const rowOf = episode => rows.get(episode);

function newRow(episode) {
  const row = document.createElement("li");
  row.dataset.episode = episode;
  row.innerHTML = `<b>${episode}</b><span class="bar"><i></i></span><small></small>`;
  row.onclick = () => open(episode);
  rows.set(episode, row);
  showRow(episode);
  return row;
}

function showRow(episode) {
  const row = rowOf(episode), entry = entries[episode];
  if (!row) return;
  const [, bar, text] = row.children;
  const said = entry.first ?? entry.guess, share = 100 * said / length(episode);
  bar.classList.toggle("guessed", entry.first === null);
  bar.firstChild.style.background = entry.mixed ? COLOUR.dim : said === undefined ? "none" :
    `linear-gradient(90deg, ${COLOUR.safe} ${share}%, ${COLOUR.fail} ${share}%)`;
  text.textContent = entry.mixed ? "mixed" : entry.first === null ? (entry.guess === undefined ? "–" : "guessed") :
    entry.first === length(episode) ? "safe" : `fails ${entry.first}`;
  text.classList.toggle("odd", entry.first !== null && entry.contradiction > 0.7);
  row.title = [entry.by && `${entry.by}${entry.at ? `, ${new Date(entry.at / 1000).toLocaleString()}` : ""}`,
    entry.contradiction > 0.7 && "the filter disagrees with this label", noSuggestion(entry)].filter(Boolean).join("; ");
  row.hidden = $("only-open").checked && !isOpen(episode) && episode !== current;
}

const noSuggestion = ({ silent }) => silent && `no suggestion, because ${silent}`;

function showVerdict() {
  const entry = entries[current], says = $("verdict");
  const kind = entry.mixed ? "open" : entry.first === null ? "open" : entry.first === length(current) ? "safe" : "fail";
  says.className = `is-${kind}`;
  says.textContent = entry.mixed ? "mixed labels" : { open: "not labelled", safe: "never fails", fail: `fails from frame ${entry.first}` }[kind];
  if (entry.by) {
    const who = document.createElement("small");
    who.textContent = ` · ${entry.by}${entry.at ? `, ${new Date(entry.at / 1000).toLocaleString()}` : ""}`;
    says.append(who);
  }
  $("view").dataset.verdict = entry.mixed ? "mixed" : entry.first ?? "open";
  const guess = entry.guess;
  $("accept").hidden = guess === undefined || entry.first !== null;
  if (guess !== undefined) $("accept").lastElementChild.textContent = guess === length(current) ? "guess: never fails" : `guess: fails from ${guess}`;
  drawTimeline();
}

function showFrame() {
  const seconds = i => (i / dataset.fps).toFixed(2);
  $("frame").textContent = `frame ${frame} of ${length(current) - 1}  ·  ${seconds(frame)} s of ${seconds(length(current) - 1)} s`;
  $("speed").textContent = `${playing ? "playing" : "paused"} · ${speed}×`;
}

function showProgress() {
  const n = entries.filter((_, episode) => !isOpen(episode)).length;
  document.querySelector("#progress i").style.width = `${100 * n / entries.length}%`;
  document.querySelector("#progress span").textContent = `${n.toLocaleString("en")} of ${entries.length.toLocaleString("en")} episodes labelled`;
}

function showSaved() {
  $("saved").textContent = waiting.length ? `${waiting.length} not saved yet` : `saved · ${dataset.user}`;
  $("saved").classList.toggle("waiting", waiting.length > 0);
}

let toastTimer;
function toast(text) {
  $("toast").textContent = text;
  $("toast").classList.add("on");
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => $("toast").classList.remove("on"), 2500);
}

function fit(canvas) { // sharp on any screen; returns a context in CSS pixels
  const scale = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale)) Object.assign(canvas, { width: Math.round(width * scale), height: Math.round(height * scale) });
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  return [context, width, height];
}

function runs(episode) { // [label, from, to] of frames with the same label
  const { first, mixed } = entries[episode], n = length(episode);
  if (!mixed) return first === null ? [[-1, 0, n]] : [[0, 0, first], [1, first, n]];
  const starts = mixed.map((_, i) => i).filter(i => i === 0 || mixed[i] !== mixed[i - 1]);
  return starts.map((from, i) => [mixed[from], from, starts[i + 1] ?? n]);
}

function drawTimeline() {
  const [c, width, height] = fit($("timeline")), n = length(current), step = width / n, strip = 10;
  c.clearRect(0, 0, width, height);
  for (const [label, from, to] of runs(current)) {
    c.fillStyle = [COLOUR.line, COLOUR.safe, COLOUR.fail][label + 1];
    c.fillRect(from * step, height - strip, (to - from) * step, strip);
    if (label !== 1) continue;
    c.globalAlpha = 0.14; // failing is also marked by a shade over the whole height, not by colour alone
    c.fillRect(from * step, 0, (to - from) * step, height - strip);
    c.globalAlpha = 1;
  }
  const zero = (height - strip) / 2, y = l => zero - l * (zero - 5);
  if (margin) {
    c.strokeStyle = COLOUR.line;
    c.beginPath(); c.moveTo(0, zero); c.lineTo(width, zero); c.stroke();
    const curve = side => {
      c.beginPath();
      if (side) c.moveTo(step / 2, zero);
      margin.forEach((l, i) => c.lineTo((i + 0.5) * step, side ? Math[side](zero, y(l)) : y(l)));
      if (side) c.lineTo((n - 0.5) * step, zero);
    };
    c.globalAlpha = 0.4;
    curve("min"); c.fillStyle = COLOUR.safe; c.fill();
    curve("max"); c.fillStyle = COLOUR.fail; c.fill();
    c.globalAlpha = 1;
    curve(); c.strokeStyle = COLOUR.text; c.lineWidth = 1.5; c.stroke();
    c.fillStyle = COLOUR.dim; c.font = "11px system-ui, sans-serif"; c.textAlign = "right";
    c.fillText("margin: looks safe", width - 6, zero - 5); c.fillText("looks failed", width - 6, zero + 13);
    c.textAlign = "left";
    const guess = entries[current].guess;
    if (guess < n) {
      c.strokeStyle = COLOUR.guess; c.setLineDash([4, 3]);
      c.beginPath(); c.moveTo(guess * step, 0); c.lineTo(guess * step, height - strip); c.stroke(); c.setLineDash([]);
    }
  } else {
    c.fillStyle = COLOUR.dim; c.font = "11px system-ui, sans-serif";
    const waiting = dataset.suggestions ? "the filter has not looked at this episode yet" : "time line: click or drag";
    c.fillText(noSuggestion(entries[current]) ?? waiting, 6, 15);
  }
  c.fillStyle = "#fff";
  c.fillRect((frame + 0.5) * step - 1, 0, 2, height);
}

let film = {}; // of the episode whose thumbnails were fetched last
async function drawFilm(episode) {
  const n = length(episode), count = Math.min(THUMBS, n);
  if (film.episode !== episode) film = { episode, thumbs: thumbnails(episode, count) };
  const thumbs = await film.thumbs.catch(error => { film = {}; throw error; });
  if (current !== episode) return;
  const [c, width, height] = fit($("film")), each = width / count;
  for (let i = 0; i < count; i++) {
    const image = await createImageBitmap(thumbs[i]);
    if (current !== episode) return;
    const scale = Math.max((each - 2) / image.width, height / image.height);
    const [w, h] = [(each - 2) / scale, height / scale];
    c.drawImage(image, (image.width - w) / 2, (image.height - h) / 2, w, h, i * each, 0, each - 2, height);
    image.close();
  }
}

function thumbnails(episode, count) { // of a short episode, which is fetched whole anyway, its own pictures
  const n = length(episode);
  if (pieceOf(n - 1) > NEAR_AHEAD) return load(0, episode, `spread=${count}`);
  return Promise.all(Array.from({ length: count }, async (_, i) => (await pictures(episode, Math.floor((i + 0.5) * n / count)))[0]));
}

// -- moving through time ---

function go(to) {
  frame = Math.max(0, Math.min(length(current) - 1, to));
  showFrame();
  drawTimeline();
  draw().catch(() => {});
  fetchAhead();
}

function stop() { clearInterval(playing); playing = 0; }

function play() {
  if (playing) { stop(); return showFrame(); }
  if (frame === length(current) - 1) frame = 0;
  const [from, started] = [frame, performance.now()];
  playing = setInterval(() => {
    go(from + Math.floor((performance.now() - started) / 1000 * dataset.fps * speed));
    if (frame === length(current) - 1) { stop(); showFrame(); }
  }, 1000 / 60);
}

function changeSpeed(by) {
  speed = SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, SPEEDS.indexOf(speed) + by))];
  if (playing) { play(); play(); }
  showFrame();
}

function scrub(canvas) {
  const to = event => go(Math.floor(event.offsetX / canvas.clientWidth * length(current)));
  canvas.onpointerdown = event => { stop(); canvas.setPointerCapture(event.pointerId); to(event); };
  canvas.onpointermove = event => { if (event.buttons) to(event); };
}

// -- keys ---

const visible = () => order.filter(episode => !$("only-open").checked || isOpen(episode) || episode === current);
const neighbour = by => { const shown = visible(); return shown[shown.indexOf(current) + by] ?? -1; };
const LABELS = {
  f: () => { stop(); mark(frame); },
  s: () => mark(length(current)),
  c: () => mark(null),
  m: () => { stop(); markFrame().catch(error => { toast(error.message); lost(error); }); },
  Enter: () => { const { guess, first } = entries[current]; if (guess !== undefined && first === null) mark(guess); },
  z: () => undo().catch(error => { toast(error.message); lost(error); }),
};
const MOVES = {
  n: () => { const next = nextOpen(current); next < 0 ? toast("Every episode is labelled.") : open(next); },
  ArrowUp: () => open(neighbour(-1)), ArrowDown: () => open(neighbour(1)),
  ArrowLeft: event => { stop(); go(frame - (event.shiftKey ? 10 : 1)); },
  ArrowRight: event => { stop(); go(frame + (event.shiftKey ? 10 : 1)); },
  Home: () => { stop(); go(0); }, End: () => { stop(); go(length(current) - 1); },
  " ": play, "+": () => changeSpeed(1), "=": () => changeSpeed(1), "-": () => changeSpeed(-1),
  "?": () => $("help").showModal(),
};

function press(event) {
  if (event.altKey || event.metaKey || $("help").open || (event.ctrlKey && event.key !== "z")) return;
  if (event.target?.matches?.("select") && event.key.startsWith("Arrow")) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const nth = dataset.specifications[Number(key) - 1];
  const act = LABELS[key] ?? MOVES[key] ?? (nth && (() => choose(nth)));
  if (!act) return;
  event.preventDefault();
  if (event.repeat && (key in LABELS || key === "n")) return; // a key held down labels one episode, not a hundred
  document.activeElement.blur();
  act(event);
}

async function choose(name) {
  await flush().catch(lost);
  specification = $("specification").value = sessionStorage.specification = name;
  await refreshAll();
  await open(current >= 0 ? current : 0);
}

async function refreshAll() {
  const all = await read(`labels/${specification}`);
  ({ changes, entries } = all);
  for (const { specification: name, episode, first } of waiting) if (name === specification) entries[episode].first = first;
  arrange(); showProgress();
  entries.forEach((_, episode) => showRow(episode));
  if (current >= 0) showVerdict();
}

async function start() {
  dataset = await read("dataset");
  document.title = `Label ${dataset.repo_id}`;
  $("dataset").textContent = dataset.repo_id;
  $("specification").replaceChildren(...dataset.specifications.map(name => new Option(name.replaceAll("_", " "), name)));
  $("cameras").replaceChildren(...dataset.cameras.map(name => {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    caption.textContent = name.replace("observation.images.", "").replace("observation.", "");
    figure.append(document.createElement("canvas"), caption);
    return figure;
  }));
  if (dataset.suggestions) $("order").value = sessionStorage.order ?? "usefulness";
  else for (const option of [...$("order").options].slice(1)) option.disabled = true;
  takeOver();
  const known = name => dataset.specifications.includes(name);
  specification = $("specification").value = known(sessionStorage.specification) ? sessionStorage.specification : dataset.specifications[0];
  await refreshAll();
  const last = Number(sessionStorage.episode ?? -1);
  await open(last >= 0 && last < entries.length && isOpen(last) ? last : isOpen(order[0]) ? order[0] : Math.max(nextOpen(order[0]), last, 0));
  $("view").dataset.ready = "yes";
}

addEventListener("keydown", press);
addEventListener("resize", () => { if (current >= 0) { drawTimeline(); drawFilm(current).catch(() => {}); } });
addEventListener("beforeunload", event => { if (waiting.length) event.preventDefault(); });
document.querySelectorAll("button[data-key]").forEach(button => { button.onclick = () => press(new KeyboardEvent("keydown", { key: button.dataset.key })); });
$("help-button").onclick = () => $("help").showModal();
$("specification").onchange = () => choose($("specification").value);
$("order").onchange = () => { sessionStorage.order = $("order").value; arrange(); fetchAhead(); };
$("only-open").onchange = () => entries.forEach((_, episode) => showRow(episode));
scrub($("timeline"));
scrub($("film"));
start().then(poll).catch(error => { $("banner").textContent = `Cannot start: ${error.message}`; $("banner").hidden = false; });
