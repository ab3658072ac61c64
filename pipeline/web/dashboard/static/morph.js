// Turns what a page shows into what it is to show, and leaves alone what is the same: focus, scrolled boxes, pictures
// that are loaded and films that play stay as they are.

const keyOf = (node) => (node.nodeType === Node.ELEMENT_NODE ? node.dataset.key : undefined);

const isSameKind = (a, b) => a.nodeType === b.nodeType && a.nodeName === b.nodeName && keyOf(a) === keyOf(b);

function takeAttributes(from, to) {
  for (const { name, value } of [...from.attributes]) {
    if (to.getAttribute(name) !== value) to.setAttribute(name, value);
  }
  for (const { name } of [...to.attributes]) {
    if (!from.hasAttribute(name)) to.removeAttribute(name);
  }
}

function become(old, wanted) {
  if (old.nodeType !== Node.ELEMENT_NODE) {
    if (old.nodeValue !== wanted.nodeValue) old.nodeValue = wanted.nodeValue;
    return;
  }
  if (old === document.activeElement && old.matches("input, select, textarea")) return; // somebody types
  const atEnd = old.hasAttribute("data-follow") && old.scrollTop + old.clientHeight >= old.scrollHeight - 4;
  takeAttributes(wanted, old);
  if (old.matches("input[type=number]")) old.value = wanted.value; // else what was typed hides what it is now
  morph(old, wanted);
  if (atEnd) old.scrollTop = old.scrollHeight;
}

/** Make the children of `shown` those of `wanted`; children with the same data-key are kept, wherever they are now. */
export function morph(shown, wanted) {
  const keyed = new Map();
  for (const child of shown.childNodes) if (keyOf(child) !== undefined) keyed.set(keyOf(child), child);
  let place = shown.firstChild;
  for (const next of [...wanted.childNodes]) {
    let match = keyOf(next) === undefined ? place : keyed.get(keyOf(next));
    if (match && !isSameKind(match, next)) match = undefined;
    if (match) {
      if (match === place) place = place.nextSibling;
      else shown.insertBefore(match, place);
      become(match, next);
    } else {
      shown.insertBefore(next, place);
    }
  }
  while (place) {
    const gone = place;
    place = place.nextSibling;
    gone.remove();
  }
}
