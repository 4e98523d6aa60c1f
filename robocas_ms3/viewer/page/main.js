"use strict";
// Starts the page: deep links (#episode=12&step=30, #decision=12) and keys.

(async () => {
  const { byId, element, noun, table, player, plots, space } = robocas;
  const shown = () => (noun() === "decision" ? robocas.decision : robocas.episode);
  let written = "";
  let later = 0;

  function follow() {
    const words = new URLSearchParams(location.hash.slice(1));
    const number = words.has(noun()) ? Number(words.get(noun())) : table.first();
    if (number === null) return shown().fail(`There are no ${noun()}s here.`);
    if (!Number.isInteger(number) || number < 0) return shown().fail(`There is no ${noun()} ${words.get(noun())}.`);
    return shown().open(number, Number(words.get("step") || 0));
  }

  function open(number) {
    if (number === null || number === shown().number()) return;
    clearTimeout(later);
    history.pushState(null, "", `#${noun()}=${number}`);
    shown().open(number);
  }

  // Browsers limit URL changes: the URL is updated when playing stops.
  function stepped(step) {
    plots.cursor(step);
    space.cursor(step);
    clearTimeout(later);
    later = setTimeout(() => {
      written = `#episode=${shown().number()}&step=${player.step()}`;
      if (shown().number() !== null && location.hash !== written) history.replaceState(null, "", written);
    }, 150);
  }

  // Lines break between the words of a command, not within its options.
  const code = (text) => element("code", {}, ...text.split(" ").flatMap((word) => [element("span", { textContent: word }), " "]).slice(0, -1));

  const LIST_KEYS = {
    ArrowUp: () => open(table.neighbour(shown().number(), -1)),
    ArrowDown: () => open(table.neighbour(shown().number(), 1)),
  };
  const EPISODE_KEYS = {
    ArrowLeft: (event) => player.by(event.shiftKey ? -10 : -1),
    ArrowRight: (event) => player.by(event.shiftKey ? 10 : 1),
    Home: () => player.go(0),
    End: () => player.go(Infinity),
    " ": () => player.toggle(),
    d: () => player.flip(),
  };

  document.addEventListener("keydown", (event) => {
    const typing = event.target.matches("select, input:not([type=range])");
    const keys = { ...LIST_KEYS, ...(noun() === "decision" ? robocas.decision.KEYS : EPISODE_KEYS) };
    const action = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key]; // D too, as with caps lock
    if (typing || !action || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action(event);
  });

  function redraw() {
    plots.redraw();
    player.recolour();
    if (shown().number() !== null) {
      plots.cursor(player.step());
      space.cursor(player.step());
    }
  }

  let index;
  try {
    index = await robocas.load("index");
  } catch (error) {
    byId("message").textContent = "The index can't be loaded. Is `robocas view` still running?";
    return;
  }
  byId("name").textContent = index.name;
  byId("kind").textContent = index.rate_hz ? `${index.kind}, ${index.rate_hz} Hz` : index.kind;
  document.title = index.name;
  byId("note").hidden = !index.note;
  byId("note").append(...index.note.split("`").map((part, i) => (i % 2 ? code(part) : part)));
  if (index.decisions) robocas.decision.start(index);
  else {
    space.start();
    player.start(index, stepped);
    new ResizeObserver(() => requestAnimationFrame(redraw)).observe(byId("lower"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  }
  table.start(index, open);
  window.addEventListener("hashchange", follow);
  window.addEventListener("popstate", follow);
  follow();
})();
