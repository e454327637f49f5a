// All is readable without this: it filters the gallery, copies blocks, and opens for the printer what belongs on paper.
"use strict";

function choice(gallery, key, name) {
  const values = [...new Set([...gallery.children].map((card) => card.dataset[key]))];
  if (values.length < 2) return null;
  const label = document.createElement("label");
  const select = document.createElement("select");
  select.append(new Option("all", ""), ...values.map((value) => new Option(value, value)));
  label.append(name + " ", select);
  return { key, label, select };
}

for (const gallery of document.querySelectorAll(".gallery")) {
  const choices = [choice(gallery, "env", "Task"), choice(gallery, "policy", "Policy")].filter(Boolean);
  const bar = document.createElement("div");
  bar.className = "choices";
  bar.append(...choices.map((one) => one.label));
  bar.addEventListener("change", () => {
    for (const card of gallery.children) {
      card.hidden = choices.some((one) => one.select.value && one.select.value !== card.dataset[one.key]);
    }
  });
  if (choices.length) gallery.before(bar);
}

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
