"use strict";
// The live page of a server: reads messages from WS /v1/live, and shows what they say. See the endpoint for their form.

const KEPT_S = 10; // times and rates are of the last seconds
const POINTS = 120; // of a sparkline
const LINGER_S = 10; // for which the card of a session that has ended stays
const LINES = 8; // most lines in one plot
const STAGES = ["decode", "queue", "inference", "encode"];
const COLOURS = ["--c0", "--c1", "--c2", "--c3", "--c4", "--c5"];
const SVG = "http://www.w3.org/2000/svg";

const byId = (id) => document.getElementById(id);
const replicas = new Map(); // by name: its last document, and what was counted lately
const cards = new Map(); // by session
let key = sessionStorage.getItem("vlagents.key") || "";
let mayOperate = false; // whether this key may press buttons
let wait = 500; // before the next attempt to connect, ms

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

// ---- connection

const path = () => location.pathname.replace(/\/live\/?$/, "/v1/live");

function connect() {
  const address = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path()}`;
  const socket = new WebSocket(address, ["vlagents.live", ...(key ? [`vlagents.key.${key}`] : [])]);
  let heard = false;
  const ask = () => socket.send(JSON.stringify({ shown: visibleSessions() }));
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { forgetFailures(); ask(); };
  socket.onmessage = (event) => {
    if (typeof event.data === "string") return say(JSON.parse(event.data).detail, false);
    heard = true;
    wait = 500;
    byId("key").hidden = true;
    document.querySelector("main").hidden = false;
    try {
      show(...read(event.data));
      if (byId("connection").textContent !== "Live") say("Live", true); // it is read aloud
    } catch (error) {
      console.error(error);
      say("Live, but a part of the last message is not shown", false);
    } finally { ask(); }
  };
  socket.onclose = (event) => {
    if (!heard) askForKey();
    else if (evaluation && !UNDER_WAY.includes(evaluation.state)) say("Ended", false);
    else say(event.reason || "Disconnected; connecting again …", false);
    setTimeout(() => { if (byId("key").hidden) connect(); }, wait);
    wait = Math.min(wait * 2, 10000);
  };
}

function say(text, good) {
  byId("connection").textContent = text;
  byId("connection").className = good ? "good" : "bad";
}

// A browser does not say why a WebSocket was refused, so the page asks the server itself.
async function askForKey() {
  const headers = key ? { authorization: `Bearer ${key}` } : {};
  let status = 0;
  try { status = (await fetch(path(), { headers })).status; } catch { /* the server is not there */ }
  if (status === 401 || (status === 403 && key)) {
    say(status === 401 && !key ? "A key is needed" : "This key may not watch here", false);
    byId("key").hidden = false;
    byId("key-text").focus();
  } else if (status === 403) say("This server shows nothing without keys", false);
  else say("Not reached; connecting again …", false);
}

byId("key").addEventListener("submit", (event) => {
  event.preventDefault();
  key = byId("key-text").value.trim();
  sessionStorage.setItem("vlagents.key", key);
  byId("key").hidden = true;
  say("Connecting …", false);
  connect();
});

function read(data) {
  const length = new DataView(data).getUint32(0, true);
  const said = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  let at = 4 + length;
  const files = said.files.map((size) => {
    at += size;
    return new Uint8Array(data, at - size, size);
  });
  return [said, files];
}

// ---- what is shown

function show(said, files) {
  mayOperate = said.may_operate;
  const present = new Set();
  let failed = null; // by one session, beside which the others are shown
  for (const replica of said.replicas) {
    count(replica, said.time);
    for (const session of replica.sessions) {
      try {
        present.add(session.id);
        if (!cards.has(session.id)) cards.set(session.id, new Card(session.id));
        cards.get(session.id).update(session, files, replica.ring_s, said.time);
      } catch (error) {
        failed = error;
        cards.get(session?.id)?.remove(); // the next message makes another
        cards.delete(session?.id);
      }
    }
  }
  const names = new Set(said.replicas.map((one) => one.name));
  for (const [name, one] of replicas) if (!names.has(name) && said.time - one.time > 3) replicas.delete(name);
  for (const [id, card] of cards) {
    if (present.has(id)) continue;
    card.end();
    if (said.time - card.seen > LINGER_S) {
      card.remove();
      cards.delete(id);
    }
  }
  if (said.evaluation) showEvaluation(said.evaluation, said.time);
  for (const section of document.querySelectorAll(".of-server")) section.hidden = evaluation !== null && !replicas.size;
  showFleet(said.time);
  showTimes();
  byId("session-count").textContent = cards.size ? `(${cards.size})` : "";
  byId("nothing").hidden = cards.size > 0;
  if (failed) throw failed;
}

function count(said, now) {
  const known = replicas.get(said.name) || { events: [] };
  known.events.push({ time: now, acts: said.acts, ms: said.ms, sizes: said.batch_sizes, errors: said.errors });
  while (known.events.length && now - known.events[0].time > KEPT_S) known.events.shift();
  replicas.set(said.name, Object.assign(known, { said, time: now, since: known.since || now }));
}

function gpuFacts(said) {
  const gb = (kind) => `${((said.gpu_memory[kind] || 0) / 1e9).toPrecision(3)} GB`;
  return [
    ...(said.devices || []).map((one) => one.name || one.device),
    ...(said.gpu_memory && "free" in said.gpu_memory ? [`${gb("allocated")} used, ${gb("reserved")} reserved, ${gb("free")} free`] : []),
    ...(said.gpu_ms == null ? [] : [`${said.gpu_ms.toFixed(1)} ms a batch on the GPU`]),
    ...(said.replays ? [`${said.replays} replays`] : []),
    ...((said.uncompiled || []).length ? [`not compiled: ${said.uncompiled.length}`] : []),
  ].join(" · ");
}

function showFleet(now) {
  const policies = [...replicas.values()].map((one) => one.said);
  if (!policies.length) return;
  if (!evaluation) {
    byId("policy").textContent = policies[0].policy;
    const digests = [...new Set(policies.map((one) => one.digest).filter(Boolean))];
    byId("checkpoint").textContent = [policies[0].checkpoint, ...digests.map((one) => one.slice(0, 31))].filter(Boolean).join(" · ");
    byId("checkpoint").title = digests.join("\n");
    document.title = `${policies[0].policy}, live`;
  }
  const several = new Set(policies.map((one) => one.policy)).size > 1;
  const rows = [...replicas].sort().map(([name, one]) => {
    const { said, events } = one;
    const seconds = Math.min(KEPT_S, Math.max(1, now - one.since));
    const sizes = events.flatMap((event) => event.sizes);
    const mean = sizes.length ? sizes.reduce((a, b) => a + b) / sizes.length : 0;
    const busy = said.utilisation ?? 0;
    const meter = element("meter", { max: 1, value: busy, high: 0.9, ariaLabel: `busy ${Math.round(busy * 100)} %` });
    return element("tr", {},
      element("th", { scope: "row" }, `${several ? `${said.policy}: ` : ""}${name} on ${said.node}`, said.ready ? "" : ` (loading${said.step ? `: ${said.step}` : ""})`,
        element("small", { title: (said.uncompiled || []).join("\n") }, gpuFacts(said))),
      element("td", {}, meter, `${Math.round(busy * 100)} %`),
      ...[(events.reduce((sum, event) => sum + event.acts, 0) / seconds).toFixed(1), mean ? mean.toFixed(1) : "–",
        said.waiting.robot, said.waiting.simulation, `${said.sessions_held} of ${said.session_limit}`,
        said.weights ? said.weights.newest.version : "–"].map((text) => element("td", { className: "n" }, String(text))));
  });
  byId("fleet").replaceChildren(...rows);
}

function showTimes() {
  const events = [...replicas.values()].flatMap((one) => one.events);
  const all = (name) => events.flatMap((event) => event.ms[name] || []);
  const totals = all("total").sort((a, b) => a - b);
  const at = (share) => totals.length ? `${totals[Math.min(totals.length - 1, Math.floor(share * totals.length))].toPrecision(3)} ms` : "–";
  byId("percentiles").replaceChildren(...[["p50", 0.5], ["p95", 0.95], ["p99", 0.99]].map(([name, share]) =>
    element("div", {}, element("b", {}, at(share)), `${name} on the server`)));
  const means = STAGES.map((name) => { const values = all(name); return values.length ? values.reduce((a, b) => a + b) / values.length : 0; });
  const bars = STAGES.map((_, i) => { const bar = element("i", { className: `k${i}` }); bar.style.flexGrow = means[i]; return bar; });
  if (byId("stages").children.length) [...byId("stages").children].forEach((bar, i) => { bar.style.flexGrow = means[i]; });
  else byId("stages").replaceChildren(...bars);
  const told = STAGES.map((name, i) => `${name} ${means[i].toFixed(2)} ms`);
  byId("stages").ariaLabel = `Mean of the last ${KEPT_S} s: ${told.join(", ")}`;
  byId("stage-names").replaceChildren(...told.map((text, i) => element("li", {}, element("i", { className: `k${i}` }), text)));
  const errors = {};
  for (const event of events) for (const [code, n] of Object.entries(event.errors)) errors[code] = (errors[code] || 0) + n;
  const listed = Object.entries(errors).map(([code, n]) => `${n} ${code}`).join(", ");
  byId("errors").textContent = listed ? `Refused or failed in the last ${KEPT_S} s: ${listed}` : `No request was refused or failed in the last ${KEPT_S} s.`;
}

// ---- cards

const pressed = (said) => `${said.do}${said.by ? `, pressed by ${said.by}` : ""}`;
const OUTCOMES = { // what became of a command
  waiting: (said) => `${pressed(said)}: waits for the robot's next request`,
  sent: (said) => `${pressed(said)}: sent, not answered yet`,
  saving: (said) => `${pressed(said)}: being written`,
  done: (said) => `${pressed(said)}: done${said.why ? `, in ${said.why}` : ""}`,
  refused: (said) => `${pressed(said)}: refused: ${said.why}`,
  ignored: (said) => `${pressed(said)}: ignored; the robot accepts no commands`,
  "too late": (said) => `${pressed(said)}: not sent, as ${said.why}`,
};
const number = (value) => String(Number(value.toPrecision(3)));

function svgElement() {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 100 100");
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("role", "img");
  return svg;
}

function polyline(points, colour) {
  const line = document.createElementNS(SVG, "polyline");
  line.setAttribute("points", points.join(" "));
  line.style.stroke = `var(${colour})`;
  return line;
}

class Card {
  constructor(id) {
    this.id = id;
    this.seen = 0; // time of the newest message about the session, s
    this.values = { step: null, "ticks in time": null, "age p95": null, server: null, "batch of": null, "weights version": null, "last request": null };
    this.series = new Map(); // by part of the state: its last rows
    this.plots = new Map(); // by name
    this.images = new Map(); // by camera
    this.instruction = element("h3", {}, "No instruction");
    this.error = element("details", { className: "bad", hidden: true }, element("summary"), element("p"));
    this.cameras = element("div", { className: "cameras" });
    this.drawn = element("div", { className: "plots" });
    this.told = element("dl");
    const unique = `${cards.size}-${Date.now()}`;
    this.name = element("p", { id: `name-${unique}`, className: "name", title: id }, id.replace(/([0-9a-f]{8})[0-9a-f]{24}$/, "$1")); // 32 of them are drawn at random
    this.outcome = element("p", { className: "note", role: "status" });
    this.stopped = element("p", { className: "stopped", role: "status", hidden: true });
    this.stoppedAt = null; // the step at which a person stopped the robot, until it begins another episode
    this.operated = this.buttons();
    this.numbers = element("details", {}, element("summary", {}, "Numbers"), this.drawn, this.told);
    this.root = element("article", {}, this.instruction, this.name, this.stopped, this.error, this.operated, this.cameras, this.numbers);
    this.instruction.id = `session-${unique}`;
    this.root.setAttribute("aria-labelledby", `session-${unique} name-${unique}`);
    this.filter();
    this.place(byId("sessions"));
  }

  // Cards are in the order of their sessions: a Stop button must be where it was at the last look.
  place(container) {
    this.root.dataset.session = this.id;
    const next = [...container.children].find((other) => other.dataset.session > this.id);
    container.insertBefore(this.root, next ?? null);
  }

  // The card keeps its place for a while after its session, so that no other card moves under the pointer.
  end() {
    this.root.classList.add("silent");
    this.operated.hidden = true;
  }

  update(said, files, ring, time) {
    this.seen = time;
    if (said.priority && said.priority !== this.priority) {
      this.priority = said.priority;
      this.name.replaceChildren(this.name.firstChild, `, ${said.priority}, ${said.transport}`);
      this.numbers.open = said.priority === "robot";
      this.place(byId(said.priority === "robot" ? "sessions" : "simulations"));
    }
    this.instruction.textContent = said.instruction ? `“${said.instruction}”` : "No instruction";
    this.filter();
    for (const [camera, index] of Object.entries(said.pictures)) this.picture(camera, files[index]);
    for (const [part, values] of Object.entries(said.state || {})) {
      const rows = this.series.get(part) || [];
      rows.push(values);
      if (rows.length > POINTS) rows.shift();
      this.series.set(part, rows);
      this.plot(`state: ${part}`, rows);
    }
    this.operated.hidden = !mayOperate || this.priority !== "robot";
    this.save.hidden = !ring;
    this.save.textContent = `Save last ${ring} s`;
    this.episode = said.episode; // a mark is for the episode that the person saw
    this.commands(said.commands);
    this.halt(said.commands, said.step);
    if (said.last) this.act(said.last);
    this.root.classList.toggle("silent", said.silent_s > 5);
    const inTime = said.in_time;
    this.tell({
      "ticks in time": inTime ? `${(100 * inTime.share).toFixed(1)} %` : null,
      "age p95": inTime && inTime.age_p95_ms !== null ? `${Math.round(inTime.age_p95_ms)} ms` : null,
      "within tolerance": inTime && inTime.within_tolerance !== null ? `${(100 * inTime.within_tolerance).toFixed(1)} %` : null,
    });
    this.tell({ step: said.step, "weights version": said.version, "last request": `${said.silent_s.toFixed(1)} s ago` });
  }

  act(act) {
    this.root.classList.toggle("failed", Boolean(act.error));
    this.error.hidden = !act.error;
    this.error.firstChild.textContent = act.error || "";
    this.error.lastChild.textContent = act.detail || "";
    if (act.action) this.plot(act.rows > 1 ? `plan: ${act.rows} rows` : "action", this.planned(act));
    const ms = act.ms;
    if (ms.inference_ms !== undefined) {
      this.tell({ server: ms.total_ms === undefined ? null : `${ms.total_ms.toFixed(1)} ms: ${STAGES.filter((name) => ms[`${name}_ms`] !== undefined).map((name) => `${name} ${ms[`${name}_ms`].toFixed(1)}`).join(", ")}`, "batch of": ms.batch_size });
    }
    this.tell(act.info || {});
  }

  // ---- for keys that may operate the session, and only if it is a robot's

  buttons() {
    const button = (text, command, className = "") => element("button", { type: "button", className, value: command,
      ariaLabel: `${text}: ${this.id}`, onclick: (event) => this.press(event.currentTarget.value) }, text);
    this.save = button("Save", "save", "quiet");
    return element("div", { className: "operate", hidden: true },
      element("div", { className: "row" }, button("Stop", "stop", "stop"), button("Pause", "pause"), button("Success", "success", "quiet"), button("Failure", "failure", "quiet")),
      element("div", { className: "row" }, this.save), this.outcome);
  }

  async press(command) {
    this.say(`${command}: on its way`);
    const headers = { "content-type": "application/json", ...(key ? { authorization: `Bearer ${key}` } : {}) };
    try {
      const answer = await fetch(`${path()}/command`, { method: "POST", headers, body: JSON.stringify({ session: this.id, do: command, episode: this.episode }) });
      const said = await answer.json();
      if (answer.ok) this.commands([said]); // what came of it may have been shown already; the next message shows it again
      else this.say(`${command}: ${said.detail}`, true);
    } catch (error) {
      this.say(`${command}: the server was not reached`, true);
    }
  }

  say(text, failed = false) {
    if (this.outcome.textContent === text) return; // a screen reader would say it again
    this.outcome.textContent = text;
    this.outcome.classList.toggle("bad", failed);
  }

  commands(said) {
    const last = said[said.length - 1];
    const state = last && `${last.id} ${last.state}`;
    if (!last || state === this.last) return;
    this.last = state;
    this.say(OUTCOMES[last.state](last), ["refused", "ignored", "too late"].includes(last.state));
  }

  halt(said, step) {
    const stop = said.filter((one) => one.do === "stop" && one.state === "done").pop();
    if (stop && stop.id !== this.stop) {
      this.stop = stop.id;
      this.stoppedAt = step;
      this.stopped.textContent = `Stopped by ${stop.by || "a person"}`;
    } else if (this.stoppedAt !== null && step < this.stoppedAt) this.stoppedAt = null;
    this.stopped.hidden = this.stoppedAt === null;
    this.root.classList.toggle("halted", this.stoppedAt !== null);
  }

  // A chunk is drawn as it is; single actions as the last of them.
  planned(act) {
    if (act.rows > 1) return act.action;
    const rows = this.series.get("\0action") || [];
    rows.push(act.action[0]);
    if (rows.length > POINTS) rows.shift();
    this.series.set("\0action", rows);
    return rows;
  }

  picture(camera, bytes) {
    let image = this.images.get(camera);
    if (!image) {
      image = element("img", { alt: `camera ${camera}` });
      this.images.set(camera, image);
      this.cameras.append(element("figure", {}, image, element("figcaption", {}, camera)));
    }
    const before = image.src;
    image.src = URL.createObjectURL(new Blob([bytes]));
    image.decode().catch(() => {}).finally(() => { if (before) URL.revokeObjectURL(before); });
  }

  plot(name, rows) {
    let svg = this.plots.get(name);
    if (!svg) {
      for (const other of this.plots.keys()) if (name.startsWith("plan") && other.startsWith("plan")) this.removePlot(other);
      svg = svgElement();
      this.plots.set(name, svg);
      this.drawn.append(element("div", {}, element("span", { className: "plot-name" }), svg));
    }
    const values = rows.flat().filter((value) => value !== null);
    const low = Math.min(...values), high = Math.max(...values), range = high - low;
    const lines = [];
    for (let joint = 0; joint < Math.min(LINES, rows[0].length); joint++) {
      const points = rows.map((row, i) => row[joint] == null ? null : `${(100 * i) / Math.max(1, rows.length - 1)},${range ? 95 - (90 * (row[joint] - low)) / range : 50}`);
      lines.push(polyline(points.filter(Boolean), COLOURS[joint % COLOURS.length]));
    }
    svg.replaceChildren(...lines);
    const told = `${name}\n${range ? `${number(low)} to ${number(high)}` : number(low)}`;
    svg.previousSibling.textContent = told;
    svg.setAttribute("aria-label", told);
  }

  removePlot(name) {
    this.plots.get(name).parentElement.remove();
    this.plots.delete(name);
  }

  tell(values) {
    Object.assign(this.values, values);
    const shown = Object.entries(this.values).filter(([, value]) => value !== null && value !== undefined);
    const text = (value) => typeof value === "number" && !Number.isInteger(value) ? value.toPrecision(4) : String(value);
    this.told.replaceChildren(...shown.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, text(value))]));
  }

  filter() {
    const sought = byId("filter").value.trim().toLowerCase();
    this.root.hidden = ![this.id, this.instruction.textContent].some((text) => text.toLowerCase().includes(sought));
  }

  get visible() {
    if (this.root.hidden || document.hidden) return false;
    const box = this.root.getBoundingClientRect();
    return box.bottom > 0 && box.top < innerHeight;
  }

  remove() {
    this.root.remove();
    for (const image of this.images.values()) URL.revokeObjectURL(image.src);
  }
}

// Only pictures that can be seen are asked for.
const visibleSessions = () => [...cards.values()].filter((card) => card.visible).map((card) => card.id);

byId("filter").addEventListener("input", () => { for (const card of cards.values()) card.filter(); });
connect();
