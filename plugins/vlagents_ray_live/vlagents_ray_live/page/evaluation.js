"use strict";
// The part of the live page about an evaluation or a training: cases that fill up, learning curves, failures.
// live.js calls showEvaluation; everything here is in its document under "evaluation".

const POLICIES = 12; // most columns of the table, the newest ones
const STATES = {
  starting: "Starting: the workers make their environments",
  running: "Running",
  waiting: "Waiting for the next version of the weights",
  complete: "Complete",
  interrupted: "Interrupted: --resume goes on",
  "out of time": "Out of time: --resume goes on",
  killed: "Killed: --resume goes on",
  stopped: "Stopped by an error",
};
const UNDER_WAY = ["starting", "running", "waiting"];
const FAILURE_NAMES = { failure: "not solved", policy_error: "error of the policy", infra_failed: "lost to infrastructure" };

const failures = new Map(); // the cards of the failed episodes, by their key
let evaluation = null; // what was said last

const percent = (share) => `${Math.round(100 * share)} %`;
const interval = (one) => `${Math.round(100 * one.low)} to ${percent(one.high)}`;

function svgNode(tag, attributes) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function showEvaluation(said, now) {
  evaluation = said;
  byId("evaluation").hidden = byId("progress").hidden = false;
  byId("policy").textContent = `${said.goes_on ? "Training" : "Evaluation"}: ${said.name}`;
  byId("checkpoint").textContent = "";
  const progress = byId("episodes-played");
  progress.max = Math.max(1, said.planned);
  progress.value = said.done;
  byId("episode-count").textContent = `${said.done} of ${said.planned} episodes${timeLeft(said, now)}`;
  document.title = `${said.planned ? Math.floor((100 * said.done) / said.planned) : 0} %, ${said.name}, live`;
  const state = STATES[said.state] + (said.reason ? `: ${said.reason}` : "");
  if (byId("evaluation-state").textContent !== state) byId("evaluation-state").textContent = state; // it is read aloud
  byId("evaluation-state").className = ["killed", "stopped"].includes(said.state) ? "bad" : "";
  byId("retries").textContent = said.retries ? `Attempts that infrastructure failed, and that were repeated: ${said.retries}` : "";
  showCases(said);
  showCurves(said.curves);
  showFailures(said);
}

function timeLeft(said, now) {
  if (said.ends === null) return "";
  const minutes = Math.max(0, said.ends - now) / 60;
  if (minutes < 1) return ", less than a minute left";
  if (minutes < 90) return `, about ${Math.round(minutes)} min left`;
  return `, about ${(minutes / 60).toFixed(1)} h left`;
}

// ---- cases

function showCases(said) {
  const shown = said.policy_ids.slice(-POLICIES);
  const older = said.policy_ids.length - shown.length;
  byId("older").textContent = older ? `${older} earlier ones are in the learning curve alone.` : "";
  byId("interval").textContent = said.cases.some((result) => result.sequence)
    ? "Upper bar: success, with a confidence sequence where a case may stop early, else Wilson's interval of 95\u00a0%. Lower bar: episodes done."
    : "Upper bar: success, with Wilson's interval of 95\u00a0%. Lower bar: episodes done.";
  const results = new Map(said.cases.map((result) => [`${result.task}\n${result.policy}`, result]));
  byId("case-policies").replaceChildren(element("th", { scope: "col" }, "Task"), ...shown.map((name) => element("th", { scope: "col" }, name)));
  byId("cases").replaceChildren(...said.tasks.map((task) =>
    element("tr", {}, element("th", { scope: "row" }, task), ...shown.map((policy) => cellOf(results.get(`${task}\n${policy}`))))));
}

function cellOf(result) {
  if (!result) return element("td", { className: "case" }, "–");
  const known = result.rate !== null;
  const inTime = result.share_in_time === null ? "" : `, ${(100 * result.share_in_time).toFixed(1)}\u00a0% of ticks in time`;
  const counts = `${result.done} of ${result.planned} episodes${result.stopped ? ", certain enough" : ""}${inTime}`;
  return element("td", { className: "case" }, element("b", {}, known ? percent(result.rate) : "–"),
    element("span", { className: "note" }, known ? ` ${interval(result)}` : ""), intervalBar(known ? result : null),
    element("progress", { max: result.planned || 1, value: result.planned ? result.done : 1, ariaLabel: counts }),
    element("span", { className: "note", ariaHidden: "true" }, counts));
}

function intervalBar(result) {
  const svg = svgNode("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none", "aria-hidden": "true", class: "interval" });
  svg.append(svgNode("rect", { x: 0, y: 4, width: 100, height: 2, class: "axis" }));
  if (result) {
    svg.append(svgNode("rect", { x: 100 * result.low, y: 2, width: Math.max(0.5, 100 * (result.high - result.low)), height: 6, class: "range" }));
    svg.append(svgNode("path", { d: `M${100 * result.rate} 0V10`, class: "rate" }));
  }
  return svg;
}

// ---- learning curves

function showCurves(curves) {
  byId("curves").hidden = !curves.length;
  if (!curves.length) return;
  const steps = curves.flatMap((curve) => curve.points.map((point) => point.step));
  const first = Math.min(...steps), last = Math.max(...steps);
  const x = (step) => (first === last ? 50 : 2 + (96 * (step - first)) / (last - first));
  const y = (share) => 100 - 100 * share;
  const drawn = [0, 0.5, 1].map((share) => svgNode("path", { d: `M0 ${y(share)}H100`, class: "grid" }));
  const told = [];
  curves.forEach((curve, i) => {
    const known = curve.points.filter((point) => point.rate !== null);
    const colour = `var(${COLOURS[i % COLOURS.length]})`;
    const lines = [svgNode("polyline", { points: known.map((point) => `${x(point.step)},${y(point.rate)}`).join(" ") })];
    for (const point of known) {
      lines.push(svgNode("path", { d: `M${x(point.step)} ${y(point.low)}V${y(point.high)}`, class: "bar" }));
      lines.push(svgNode("path", { d: `M${x(point.step)} ${y(point.rate)}h0`, class: point.whole ? "dot" : "dot begun" }));
    }
    for (const line of lines) line.style.stroke = colour;
    drawn.push(...lines);
    told.push(`${curve.policy}: ${known.map((point) => `${point.step}: ${percent(point.rate)} (${interval(point)})`).join(", ")}`);
  });
  byId("curve").replaceChildren(...drawn);
  byId("curve").setAttribute("aria-label", `Success by step. ${told.join(". ")}`);
  byId("first-step").textContent = first.toLocaleString("en");
  byId("last-step").textContent = first === last ? "" : last.toLocaleString("en");
  byId("curve-names").replaceChildren(...curves.map((curve, i) => {
    const latest = curve.points[curve.points.length - 1];
    const now = latest.rate === null ? "" : `: ${percent(latest.rate)} (${interval(latest)}) at ${latest.step.toLocaleString("en")}`;
    return element("li", {}, element("i", { className: `k${i % COLOURS.length}` }), `${curve.policy}${now}`);
  }));
}

// ---- failures

function showFailures(said) {
  byId("failure-count").textContent = said.failed;
  const left = said.failed - said.failures.length;
  byId("more-failures").textContent = left ? `${left} earlier ones are in the report.` : "";
  const present = new Set(said.failures.map((one) => one.key));
  for (const [name, card] of failures) if (!present.has(name)) { removeFailure(card); failures.delete(name); }
  for (const one of [...said.failures].reverse()) {
    if (failures.has(one.key)) continue;
    failures.set(one.key, failureCard(one));
    byId("failures").prepend(failures.get(one.key));
  }
}

function failureCard(one) {
  const name = `${one.task}, episode ${one.episode}`;
  const title = element("h3", { id: `failure-${one.key}` }, name);
  const about = [FAILURE_NAMES[one.outcome] || one.outcome, one.policy, `seed ${one.seed}`, `${one.steps} steps`, new Date(1000 * one.finished).toLocaleTimeString()];
  const card = element("article", {},
    ...one.videos.map((number) => videoOf(number, name)),
    title,
    element("p", { className: "instruction" }, one.instruction ? `“${one.instruction}”` : ""),
    element("p", { className: "bad" }, one.error),
    element("p", { className: "note" }, about.join(", ")));
  card.setAttribute("aria-labelledby", title.id);
  return card;
}

// A video is requested when it can be seen. A page cannot send a key with `src`, so the script requests it.
const inView = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) if (isIntersecting) { inView.unobserve(target); loadVideo(target); }
});

function videoOf(number, name) {
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const video = element("video", { controls: calm, muted: true, loop: true, playsInline: true, autoplay: !calm, tabIndex: 0, ariaLabel: `Video: ${name}` });
  video.onclick = video.onfocus = () => { video.controls = true; }; // they would cover most of a small picture
  video.dataset.number = number;
  inView.observe(video);
  return video;
}

async function loadVideo(video) {
  try {
    const answer = await fetch(`${path()}/videos/${video.dataset.number}`, { headers: key ? { authorization: `Bearer ${key}` } : {} });
    if (!answer.ok) throw new Error(String(answer.status));
    video.src = URL.createObjectURL(await answer.blob());
  } catch { video.replaceWith(element("p", { className: "note" }, "Its video is not there any more.")); }
}

// Another evaluation may be at this address now, with other numbers of its videos.
function forgetFailures() {
  for (const card of failures.values()) removeFailure(card);
  failures.clear();
}

function removeFailure(card) {
  for (const video of card.querySelectorAll("video")) { inView.unobserve(video); URL.revokeObjectURL(video.src); }
  card.remove();
}
