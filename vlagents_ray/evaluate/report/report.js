// All is readable without this: it filters galleries and episodes, plays videos, copies blocks, and opens for the printer what belongs on paper.
"use strict";

const PAGE = 500; // rows of the table of episodes

function chooser(name, values) {
  const label = document.createElement("label");
  const select = document.createElement("select");
  select.append(new Option("all", ""), ...values.map((value) => new Option(value, value)));
  label.append(name + " ", select);
  return { label, select };
}

// Selects above `place` that hide what is not chosen: `keys` are [name, value of an item], and `all` the items.
function filters(place, all, keys, changed) {
  const choices = [];
  for (const [name, value] of keys) {
    const values = [...new Set(all.map(value))];
    if (values.length > 1) choices.push({ value, ...chooser(name, values) });
  }
  const bar = document.createElement("div");
  bar.className = "choices";
  bar.append(...choices.map((one) => one.label));
  bar.addEventListener("change", () => {
    for (const item of all) {
      item.out = choices.some((one) => one.select.value && one.select.value !== one.value(item));
      item.hidden = item.out;
    }
    changed(bar);
  });
  if (choices.length) place.before(bar);
  changed(bar);
}

for (const gallery of document.querySelectorAll(".gallery")) {
  filters(gallery, [...gallery.children], [["Task", (card) => card.dataset.env], ["Policy", (card) => card.dataset.policy]], () => {});
}

for (const table of document.querySelectorAll(".episodes")) {
  const rows = [...table.querySelectorAll("tbody tr")];
  const counted = document.createElement("output");
  const more = document.createElement("button");
  let most = PAGE;
  const limit = () => { // a browser lays thousands of rows out for seconds
    const chosen = rows.filter((row) => !row.out);
    chosen.forEach((row, place) => { row.hidden = place >= most; });
    more.hidden = chosen.length <= most;
    more.textContent = `Show ${PAGE} more of ${chosen.length}`;
  };
  more.type = "button";
  more.addEventListener("click", () => { most += PAGE; limit(); });
  table.after(more);
  const keys = ["Task", "Policy", "Outcome"].map((name, column) => [name, (row) => row.cells[column].textContent]);
  filters(table, rows, keys, (bar) => {
    counted.value = rows.filter((row) => !row.out).length + " of " + rows.length;
    bar.append(counted);
    limit();
  });
  for (const rest of table.querySelectorAll("tbody[hidden]")) rest.hidden = false; // its rows are hidden now
  table.querySelectorAll("thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "sort";
    button.append(...head.childNodes);
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      table.querySelectorAll("thead th").forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const key = (row) => row.cells[column].textContent.replace(/[\s\u202f]/g, "");
      const compare = new Intl.Collator("en", { numeric: true }).compare;
      const number = (text) => (text === "" || isNaN(text) ? null : Number(text));
      rows.sort((a, b) => {
        const [one, other] = [number(key(a)), number(key(b))];
        return (up ? 1 : -1) * (one !== null && other !== null ? one - other : compare(key(a), key(b)));
      });
      limit();
      rows[0].parentNode.append(...rows);
    });
    head.append(button);
  });
}

// Videos of the table play in the page, one after another.
const links = () => [...document.querySelectorAll(".episodes a.video")].filter((link) => !link.closest("tr").out);
let viewer = null;
function show(link) {
  if (!viewer) {
    viewer = document.createElement("dialog");
    viewer.className = "viewer";
    viewer.innerHTML = "<p></p><video controls muted playsinline autoplay></video><form method=dialog>" +
      "<button type=button>Previous</button><button type=button>Next</button><button>Close</button></form>";
    const [previous, next] = viewer.querySelectorAll("button");
    previous.addEventListener("click", () => step(-1));
    next.addEventListener("click", () => step(1));
    viewer.addEventListener("keydown", (event) => {
      if (event.target.tagName === "VIDEO") return;
      if (event.key === "ArrowLeft") step(-1);
      if (event.key === "ArrowRight") step(1);
    });
    const video = viewer.querySelector("video");
    video.addEventListener("loadedmetadata", () => { // with a strip below the picture for the controls
      const tall = video.videoHeight / video.videoWidth, strip = 58;
      const width = Math.min(viewer.querySelector("p").clientWidth, (0.7 * innerHeight - strip) / tall);
      video.style.width = width + "px";
      video.style.height = width * tall + strip + "px";
    });
    viewer.addEventListener("close", () => viewer.querySelector("video").removeAttribute("src"));
    document.body.append(viewer);
  }
  viewer.link = link;
  const cells = [...link.closest("tr").cells].map((cell) => cell.textContent);
  viewer.querySelector("p").textContent = `${cells[0]}, ${cells[1]}: ${cells[2]}, seed ${cells[4]}, ${cells[6]} steps`;
  viewer.querySelector("video").src = link.href;
  if (!viewer.open) viewer.showModal();
}
function step(by) {
  const all = links();
  show(all[(all.indexOf(viewer.link) + by + all.length) % all.length]);
}
addEventListener("click", (event) => {
  const link = event.target.closest(".episodes a.video");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  show(link);
});

for (const block of document.querySelectorAll(".block")) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Copy";
  button.addEventListener("click", () => {
    getSelection().selectAllChildren(block.querySelector("code"));
    document.execCommand("copy"); // the newer way is refused to pages that are opened from a disk
    button.textContent = "Copied";
  });
  block.append(button);
}

addEventListener("beforeprint", () => {
  for (const fold of document.querySelectorAll("details.printed:not([open])")) {
    fold.open = true;
    addEventListener("afterprint", () => { fold.open = false; }, { once: true });
  }
});
