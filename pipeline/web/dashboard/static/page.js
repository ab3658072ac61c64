// Keeps a page up to date: it asks for the parts that have changed, a second after the last answer, and only while
// somebody looks at it. So a slow network asks less often, and a page in the background not at all.

import { morph } from "./morph.js";
import { setUpViewer } from "./viewer.js";

const INTERVAL_MS = 1000;
const LONGEST_INTERVAL_MS = 8000;
const trouble = document.getElementById("trouble");
let timer = 0;
let asking = null;
let failures = 0;

const parts = () => [...document.querySelectorAll("[data-part]")];
const isPlaying = (part) => [...part.querySelectorAll("video")].some((video) => !video.paused && !video.ended);

function show(name, { tag, html }) {
  const part = parts().find((each) => each.dataset.part === name);
  if (!part || isPlaying(part)) return; // it is asked for again until the film pauses
  const template = document.createElement("template");
  template.innerHTML = html;
  morph(part, template.content);
  part.dataset.tag = tag;
}

function tell(sentence) {
  trouble.textContent = sentence;
  trouble.hidden = !sentence;
}

async function refresh() {
  clearTimeout(timer);
  asking?.abort();
  const request = (asking = new AbortController());
  try {
    const answer = await fetch(document.body.dataset.live + location.search, {
      headers: { Accept: "application/json", "Known-Parts": parts().map((p) => `${p.dataset.part}=${p.dataset.tag}`).join() },
      signal: request.signal,
    });
    const said = answer.status === 204 ? {} : await answer.json();
    if (answer.status === 401 || answer.status === 403) return location.reload();
    failures = answer.ok ? 0 : failures + 1;
    tell(answer.ok ? "" : said.message);
    for (const [name, part] of Object.entries(said.parts ?? {})) show(name, part);
  } catch (error) {
    if (error.name === "AbortError") return; // another one has taken its place
    failures += 1;
    if (failures > 1) tell("The dashboard does not answer. What you see may be old; it is asked again.");
  }
  schedule();
}

function schedule() {
  clearTimeout(timer);
  if (document.hidden) return;
  timer = setTimeout(refresh, Math.min(INTERVAL_MS * 2 ** failures, LONGEST_INTERVAL_MS));
}

function toast(sentence, bad = false) {
  const note = document.createElement("p");
  note.textContent = sentence;
  note.className = bad ? "toast bad" : "toast";
  document.getElementById("toasts").append(note);
  setTimeout(() => note.remove(), bad ? 9000 : 5000);
}

function confirmed(sentence, label) {
  const dialog = document.getElementById("confirm");
  dialog.querySelector("p").textContent = sentence;
  dialog.querySelector(".danger").textContent = `${label} the job`;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
  });
}

async function act(form, button) {
  if (form.dataset.confirm && !(await confirmed(form.dataset.confirm, button.textContent))) return;
  button.disabled = true;
  document.activeElement?.blur(); // so that a number that was typed is shown as it is now
  try {
    const answer = await fetch(form.action, {
      method: "POST",
      headers: { Accept: "application/json" },
      body: new URLSearchParams(new FormData(form)),
    });
    toast((await answer.json()).message, !answer.ok);
    if (!answer.ok) form.reset(); // to what it is still
  } catch {
    toast("The dashboard does not answer; nothing was changed.", true);
  }
  button.disabled = false;
  refresh();
}

function goTo(address) {
  history.pushState(null, "", address);
  const place = document.getElementById(address.hash.slice(1));
  refresh().then(() => address.hash === "#story" && place?.scrollIntoView({ block: "nearest", behavior: "smooth" }));
}

function filter(form) {
  const asked = new URLSearchParams([...new FormData(form)].filter(([, value]) => value));
  const address = new URL(location.href);
  address.search = asked;
  address.hash = form.dataset.filter;
  history.replaceState(null, "", address);
  refresh();
}

function fillFilter() {
  const form = document.querySelector("form[data-filter]");
  const asked = new URLSearchParams(location.search);
  for (const field of form?.elements ?? []) if (field.name) field.value = asked.get(field.name) ?? "";
}

document.addEventListener("submit", (event) => {
  if (event.target.matches("form[data-action]")) {
    event.preventDefault();
    act(event.target, event.submitter ?? event.target.querySelector("button"));
  } else if (event.target.matches("form[data-filter]")) {
    event.preventDefault();
    filter(event.target);
  }
});
document.addEventListener("input", (event) => {
  const form = event.target.closest("form[data-filter]");
  if (form) filter(form);
});
document.addEventListener("click", (event) => {
  const link = event.target.closest("a[data-stay]");
  if (!link || event.metaKey || event.ctrlKey || event.shiftKey || event.button) return;
  event.preventDefault();
  goTo(new URL(link.href));
  fillFilter();
});
document.addEventListener("visibilitychange", () => (document.hidden ? clearTimeout(timer) : refresh()));
document.addEventListener("pause", refresh, true); // a newer film may have waited
// A picture that cannot be loaded leaves its frame empty; no sign of breakage that flickers by.
document.addEventListener("error", (event) => event.target.matches?.("img") && event.target.classList.add("missing"), true);
document.addEventListener("load", (event) => event.target.matches?.("img") && event.target.classList.remove("missing"), true);
window.addEventListener("popstate", () => {
  fillFilter();
  refresh();
});

setUpViewer(document.getElementById("viewer"));
for (const log of document.querySelectorAll("[data-follow]")) log.scrollTop = log.scrollHeight;
schedule();
