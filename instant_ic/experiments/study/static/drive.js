// @ts-check
// Ends the drive by its button, and leaves the page when the drive has ended.

const POLL_MS = 500;

// Only driving keys reach the console's page: its other shortcuts would record, save and open dialogs.
const KEYS = new Set(["KeyW", "KeyA", "KeyS", "KeyD", "ArrowUp", "ArrowLeft", "ArrowDown", "ArrowRight", "Space",
  "KeyI", "KeyJ", "KeyK", "KeyL", "KeyC", "Tab", "Enter", "Minus", "Equal", "NumpadSubtract", "NumpadAdd"]);
window.addEventListener("keydown", (event) => {
  if (!KEYS.has(event.code)) event.stopImmediatePropagation();
}, { capture: true });

document.getElementById("study-end")?.addEventListener("click", (event) => {
  if (event.currentTarget instanceof HTMLButtonElement) event.currentTarget.disabled = true;
  const body = new URLSearchParams({ step: document.body.dataset.step ?? "", action: "finish" });
  fetch("/", { method: "POST", body }).finally(() => location.assign("/"));
});

setInterval(async () => {
  const status = await fetch("/study/status").then((answer) => answer.text()).catch(() => "ready");
  if (status !== "ready") location.assign("/");
}, POLL_MS);
