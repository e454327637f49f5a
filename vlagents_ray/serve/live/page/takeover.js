"use strict";
// "Take over" on a card: a panel with which a human moves the session's robot, over WS /v1/live/control.

const MOVES = [ // key, axis, direction, what the button says; as vlagents_ray.robot.teleoperation.keyboard has them
  ["w", 0, 1, "+x"], ["s", 0, -1, "−x"], ["a", 1, 1, "+y"], ["d", 1, -1, "−y"], ["r", 2, 1, "+z"], ["f", 2, -1, "−z"],
  ["o", 3, 1, "+roll"], ["u", 3, -1, "−roll"], ["i", 4, 1, "+pitch"], ["k", 4, -1, "−pitch"], ["j", 5, 1, "+yaw"], ["l", 5, -1, "−yaw"],
];
const PULSE_MS = 200; // a click of a keyboard or a screen reader, which have no release

class Takeover {
  constructor(card) {
    this.card = card;
    this.pressed = new Map(); // by key, how many ways it is pressed
    this.button = element("button", { type: "button", hidden: true, onclick: () => this.open() }, "Take over");
    this.status = element("p", { role: "status", className: "note" });
    this.pad = element("div", { className: "pad", tabIndex: 0 }, ...MOVES.map((move) => this.mover(...move)),
      element("button", { type: "button", ariaLabel: "Gripper, Space", onclick: () => this.grip() }, "Gripper ", element("kbd", {}, "Space")));
    this.pad.setAttribute("role", "application"); // so that a screen reader leaves the keys to it
    this.pad.setAttribute("aria-label", `Move ${card.id}: W and S along x, A and D along y, R and F along z, U and O, I and K, J and L turn, Space opens and closes the gripper, Escape gives back`);
    const release = element("button", { type: "button", ariaLabel: `Release: ${card.id}`, onclick: () => this.release() }, "Release ", element("kbd", {}, "Esc"));
    this.root = element("section", { className: "takeover", hidden: true, ariaLabel: `You move ${card.id}` }, this.status, this.pad, release);
    this.root.addEventListener("keydown", (event) => this.key(event, true));
    this.root.addEventListener("keyup", (event) => this.key(event, false));
    this.root.addEventListener("focusout", (event) => { if (!this.root.contains(event.relatedTarget)) this.letGo(); });
  }

  mover(key, axis, sign, text) {
    const button = element("button", { type: "button", ariaLabel: `${text}, ${key.toUpperCase()}`, value: key,
      onclick: (event) => { if (!event.detail) { this.press(key, 1); setTimeout(() => this.press(key, -1), PULSE_MS); } },
      oncontextmenu: (event) => event.preventDefault(),
      onpointerdown: (event) => { button.setPointerCapture(event.pointerId); button.dataset.held = "yes"; this.press(key, 1); },
      onlostpointercapture: () => { if (button.dataset.held) { delete button.dataset.held; this.press(key, -1); } } },
    `${text} `, element("kbd", {}, key.toUpperCase()));
    return button;
  }

  // Whether the session's robot may be moved from here, and by whom it is.
  update(robot) {
    this.button.hidden = !robot;
    const taken = Boolean(robot && robot.by !== null && !this.socket);
    this.button.disabled = taken || !this.root.hidden;
    const by = taken ? `Taken over by ${robot.by || "somebody"}` : "Take over";
    if (this.button.textContent !== by) this.button.textContent = by;
    this.button.ariaLabel = `${by}: ${this.card.id}`;
  }

  open() {
    if (this.socket) return;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${path()}/control`, ["vlagents.live", ...(key ? [`vlagents.key.${key}`] : [])]);
    this.socket = socket;
    this.seq = this.grips = this.beat = 0;
    this.over = "";
    socket.onopen = () => socket.send(JSON.stringify({ session: this.card.id }));
    socket.onmessage = (event) => {
      const said = JSON.parse(event.data);
      if (said.beat === undefined) { this.over = said.over || said.detail; return; }
      this.beat = said.beat;
      this.send();
      if (this.root.hidden) this.show(true);
      this.say(said.moves ? "You move it." : `It holds still${said.why ? `: ${said.why}` : "."}`);
    };
    socket.onclose = () => { if (this.socket === socket) this.end(); };
  }

  end() {
    this.socket = null;
    this.pressed.clear();
    this.show(false);
    this.card.say(`take over: ${this.over === "given back" ? "given back; the policy goes on" : `over: ${this.over || "the server was not reached"}`}`, this.over !== "given back");
  }

  show(shown) {
    const focused = this.root.contains(document.activeElement);
    this.root.hidden = !shown;
    this.button.disabled = shown;
    this.card.root.classList.toggle("steered", shown);
    if (shown) this.pad.focus();
    else if (focused) this.button.focus();
  }

  key(event, down) {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const pressed = event.key.toLowerCase();
    if (MOVES.some(([one]) => one === pressed)) { if (!event.repeat) this.hold(pressed, down); }
    else if (event.key === "Escape") { if (down) this.release(); }
    else if (event.key === " " && event.target === this.pad) { if (down && !event.repeat) this.grip(); }
    else return;
    event.preventDefault();
  }

  hold(name, down) {
    if (down) this.pressed.set(name, 1);
    else this.pressed.delete(name);
    this.send();
  }

  press(name, more) {
    const left = (this.pressed.get(name) || 0) + more;
    if (left > 0) this.pressed.set(name, left);
    else this.pressed.delete(name);
    this.send();
  }

  letGo() {
    this.pressed.clear();
    this.send();
  }

  grip() {
    this.grips++;
    this.send();
  }

  send() {
    if (!this.socket || this.socket.readyState !== WebSocket.OPEN) return;
    const axes = [0, 0, 0, 0, 0, 0];
    for (const [name, axis, sign] of MOVES) if (this.pressed.has(name)) axes[axis] += sign;
    for (const button of this.pad.querySelectorAll("button[value]")) button.classList.toggle("on", this.pressed.has(button.value));
    this.socket.send(JSON.stringify({ seq: this.seq++, beat: this.beat, axes, grips: this.grips }));
  }

  release() {
    if (this.socket && this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ release: true }));
  }

  say(text) {
    const words = text.replace(/[\d.]+/g, ""); // a screen reader would say each change
    if (this.words !== words) this.status.textContent = text;
    this.words = words;
  }

  close() {
    if (this.socket) this.socket.close();
  }
}

// A page that nobody looks at moves nothing.
const letAllGo = () => { for (const card of cards.values()) card.takeover.letGo(); };
addEventListener("blur", letAllGo);
document.addEventListener("visibilitychange", () => { if (document.hidden) letAllGo(); });
