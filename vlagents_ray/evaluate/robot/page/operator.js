"use strict";
const $ = (id) => document.getElementById(id);
const PHASES = { scene: "Set the scene", playing: "Running", verdict: "Your verdict", next: "One moment …" };
let state = null;
let shown = "";

async function look() {
  if (!document.hidden) await refresh();  // when nobody looks, the server stops a running trial
  if (state === null || state.phase !== "end") setTimeout(look, 300);
}

async function refresh() {
  try {
    const answer = await fetch("now/state");
    if (!answer.ok) throw new Error(String(answer.status));
    show(await answer.json());
  } catch {
    state = null;
    shown = "";
    $("phase").textContent = "No connection to the evaluation: see the terminal";
    for (const part of document.querySelectorAll("[data-phase]")) part.hidden = true;
  }
}

function show(found) {
  state = found;
  if (state.phase === "end") return showEnd();
  $("phase").textContent = state.answered ? PHASES.next : PHASES[state.phase];
  const trial = state.trial;
  cameras();
  for (const part of document.querySelectorAll("[data-phase]")) {
    part.hidden = trial === null || part.dataset.phase !== state.phase || state.answered;
  }
  if (trial === null) return;
  const name = `${state.phase} ${trial.number} ${trial.attempt}`;
  if (name === shown) return;
  shown = name;
  $("task").hidden = false;
  $("count").textContent = `Trial ${trial.number} of ${trial.total}: ${trial.task}, scene ${trial.scene}`;
  document.title = `Trial ${trial.number} of ${trial.total}`;
  $("instruction").textContent = trial.instruction;
  $("setup").textContent = trial.setup;
  $("message").textContent = state.phase === "scene" ? trial.message : "";
  $("ending").textContent = state.ending;
  $("note").value = "";
  $("error").textContent = "";
  const parts = Object.entries(trial.rubric).map(([part, points]) => {
    const label = document.createElement("label");
    const box = document.createElement("input");
    box.type = "checkbox";
    box.value = part;
    label.append(box, ` ${part} (${points} ${points === 1 ? "point" : "points"})`);
    return label;
  });
  $("rubric").hidden = parts.length === 0;
  $("parts").replaceChildren(...parts);
  const first = document.querySelector("[data-phase]:not([hidden]) button");
  if (state.phase === "playing" && first) first.focus();
}

function showEnd() {
  $("count").textContent = document.title = "The end";
  $("phase").textContent = state.ending;
  $("task").hidden = $("overlay").hidden = $("answers").hidden = true;
  $("cameras").replaceChildren();
}

function cameras() {
  const here = [...$("cameras").children].map((one) => one.dataset.name).join("\n");
  if (here !== state.cameras.join("\n")) {
    $("cameras").replaceChildren(...state.cameras.map(camera));
  }
  const start = state.phase === "scene" && state.trial !== null ? state.trial.start : [];
  $("overlay").hidden = start.length === 0;
  for (const figure of $("cameras").children) {
    const [, over] = figure.querySelectorAll("img");
    const name = figure.dataset.name;
    over.hidden = !start.includes(name);
    const source = over.hidden ? "" : `start/${encodeURIComponent(name)}?${state.trial.task} ${state.trial.scene}`;
    if (over.dataset.source !== source) {
      over.dataset.source = source;
      if (source) over.src = source;
    }
    over.classList.toggle("difference", $("difference").checked);
    over.style.opacity = $("difference").checked ? "1" : String($("opacity").value / 100);
  }
}

function camera(name) {
  const figure = document.createElement("figure");
  figure.dataset.name = name;
  const frame = document.createElement("div");
  const live = document.createElement("img");
  const over = document.createElement("img");
  live.alt = `${name}, live`;
  over.alt = `${name} at the first start of this scene`;
  over.hidden = true;
  const caption = document.createElement("figcaption");
  caption.textContent = name;
  frame.append(live, over);
  figure.append(frame, caption);
  const renew = () => {
    if (figure.isConnected) live.src = `now/camera/${encodeURIComponent(name)}?${Date.now()}`;
  };
  live.onload = () => setTimeout(renew, 100);
  live.onerror = () => setTimeout(renew, 1000);
  setTimeout(renew);
  return figure;
}

async function answer(choice) {
  if (state === null || state.trial === null) return;
  const earned = [...$("parts").querySelectorAll("input:checked")].map((box) => box.value);
  const body = { phase: state.phase, trial: state.trial.number, attempt: state.trial.attempt, do: choice, note: $("note").value };
  if (choice === "partial") body.earned = earned;
  const said = await fetch("now/answer", {
    method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body),
  });
  $("error").textContent = said.ok ? "" : await said.text();
}

for (const button of document.querySelectorAll("[data-do]")) {
  button.addEventListener("click", () => answer(button.dataset.do));
}
look();
