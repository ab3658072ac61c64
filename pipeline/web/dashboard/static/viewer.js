// Frames in full: a click on a small one opens it; arrow keys and swipes step through those of the page.

export function setUpViewer(dialog) {
  const picture = dialog.querySelector("img");
  const label = dialog.querySelector("span");
  let frame = null;

  // By number, once each: the newest frame also stands for the film where there is none.
  const frames = () =>
    [...new Map([...document.querySelectorAll("a[data-frame]")].map((link) => [Number(link.dataset.frame), link.href]))]
      .sort((a, b) => a[0] - b[0]);

  function show(number) {
    const found = frames().find(([each]) => each === number);
    if (!found) return;
    frame = number;
    picture.src = found[1];
    picture.alt = label.textContent = `frame ${number}`;
    if (!dialog.open) dialog.showModal();
  }

  function step(by) {
    const numbers = frames().map(([number]) => number);
    const next = numbers[numbers.indexOf(frame) + by];
    if (next !== undefined) show(next);
  }

  document.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-frame]");
    if (!link || event.metaKey || event.ctrlKey || event.shiftKey) return;
    event.preventDefault();
    show(Number(link.dataset.frame));
  });
  dialog.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (button?.dataset.step) step(Number(button.dataset.step));
    else if (button || event.target === dialog || event.target === picture) dialog.close();
  });
  dialog.addEventListener("keydown", (event) => {
    if (event.key === "ArrowLeft") step(-1);
    if (event.key === "ArrowRight") step(1);
  });
  let touched = null;
  dialog.addEventListener("touchstart", (event) => (touched = event.touches[0].clientX), { passive: true });
  dialog.addEventListener("touchend", (event) => {
    const moved = event.changedTouches[0].clientX - touched;
    if (Math.abs(moved) > 48) step(moved > 0 ? -1 : 1);
  });
}
