"use strict";
// The episode table: filters, sorting, and rows created when visible.

robocas.table = (() => {
  const { byId, element, noun, thumbnailUrl } = robocas;
  const HEIGHT = 52; // of a row, as in style.css
  const SPARE = 6; // rows beyond the visible ones
  const EPISODES = {
    tasks: "All tasks", objects: "All objects", stages: "Any attempts", stage: "failed at ", outcomes: "Any outcome", counted: "Steps",
    object: "Object", count: "Steps", outcome: "Outcome",
  };
  const DECISIONS = {
    tasks: "All kinds", objects: "All targets", stages: "Any candidates", stage: "with ", outcomes: "Any chosen", counted: "Candidates",
    object: "Target", count: "Cand.", outcome: "Chosen",
  };
  let words = EPISODES;
  let index = null;
  let shown = []; // rows that pass the filters, sorted
  let chosen = null;
  let sort = { key: "n", down: false };
  let onOpen = () => {};
  const made = new Map(); // position -> element

  function start(content, open) {
    index = content;
    onOpen = open;
    words = noun() === "decision" ? DECISIONS : EPISODES;
    byId("f-counted").textContent = words.counted;
    const values = (key) => [...new Set(index.episodes.flatMap((e) => e[key]).filter((v) => v !== "" && v !== null))].sort();
    options("f-task", words.tasks, values("task"), 2);
    options("f-object", words.objects, values("object"), 2);
    options("f-stage", words.stages, values("stages"), noun() === "decision" ? 2 : 1, words.stage);
    const damaged = index.episodes.some((e) => e.damage) ? ["damaged"] : [];
    options("f-success", words.outcomes, [...values("success").map((v) => (v ? "success" : "failure")), ...damaged], 1);
    heads();
    byId("filters").addEventListener("input", apply);
    byId("filters").addEventListener("submit", (event) => event.preventDefault());
    byId("filters").addEventListener("reset", () => setTimeout(apply));
    byId("rows").addEventListener("scroll", draw, { passive: true });
    new ResizeObserver(() => requestAnimationFrame(draw)).observe(byId("rows"));
    apply();
  }

  // A filter without a choice is hidden.
  function options(id, all, values, least, prefix = "") {
    const select = byId(id);
    select.replaceChildren(element("option", { value: "", textContent: all }));
    for (const value of values) select.append(element("option", { value, textContent: prefix + String(value).replaceAll("_", " ") }));
    select.hidden = values.length < least;
  }

  function heads() {
    const columns = [["", ""], ["n", "#"], ["object", words.object], ["steps", words.count], ["success", words.outcome]];
    const box = byId("heads");
    box.classList.toggle("plain", !index.cameras.length);
    box.replaceChildren();
    for (const [key, title] of index.cameras.length ? columns : columns.slice(1)) {
      if (!key) { box.append(element("span")); continue; }
      const arrow = sort.key === key ? (sort.down ? " \u2193" : " \u2191") : "";
      const button = element("button", { textContent: title + arrow, title: `Sort by ${key === "n" ? noun() : title.toLowerCase()}` });
      if (key === "n" || key === "steps") button.className = "number";
      button.onclick = () => {
        sort = { key, down: sort.key === key && !sort.down };
        heads();
        apply();
      };
      box.append(button);
    }
  }

  function passes() {
    const words = byId("f-text").value.toLowerCase().split(/\s+/).filter(Boolean);
    const [task, object, stage, success] = ["f-task", "f-object", "f-stage", "f-success"].map((id) => byId(id).value);
    const least = parseFloat(byId("f-min").value);
    const most = parseFloat(byId("f-max").value);
    return (e) => {
      const text = `${e.instruction} ${e.object} ${e.n ?? ""} seed:${e.seed}`.toLowerCase();
      return (
        words.every((word) => text.includes(word)) &&
        (!task || e.task === task) &&
        (!object || e.object === object) &&
        (!stage || e.stages.includes(stage)) &&
        (!success || (success === "damaged" ? e.damage : e.success === (success === "success"))) &&
        !(e.steps < least) && // NaN, an empty field, passes all
        !(e.steps > most)
      );
    };
  }

  function apply() {
    const { key, down } = sort;
    const rank = (e) => (e[key] === null || e[key] === "" ? Infinity : e[key]);
    const order = (a, b) => {
      const [x, y] = [rank(a), rank(b)];
      if (x === y) return (a.n ?? Infinity) - (b.n ?? Infinity) || a.seed - b.seed;
      if (x === Infinity || y === Infinity) return x === Infinity ? 1 : -1; // unknown values last
      return (x < y ? -1 : 1) * (down ? -1 : 1);
    };
    shown = index.episodes.filter(passes()).sort(order);
    const isSkipped = (e) => e.n === null;
    const skipped = counted(isSkipped, "seed");
    byId("count").textContent = counted((e) => !isSkipped(e), noun()) + (skipped ? `, ${skipped} skipped` : "");
    byId("f-reset").hidden = shown.length === index.episodes.length;
    byId("spacer").style.height = `${shown.length * HEIGHT}px`;
    for (const row of made.values()) row.remove();
    made.clear();
    draw();
  }

  // "3 episodes", "1 of 3 episodes"; empty without skipped seeds.
  function counted(which, name) {
    const [some, all] = [shown.filter(which).length, index.episodes.filter(which).length];
    if (!all && name !== noun()) return "";
    return `${some === all ? all : `${some} of ${all}`} ${name}${all === 1 ? "" : "s"}`;
  }

  function draw() {
    const box = byId("rows");
    const first = Math.max(0, Math.floor(box.scrollTop / HEIGHT) - SPARE);
    const last = Math.min(shown.length, Math.ceil((box.scrollTop + box.clientHeight) / HEIGHT) + SPARE);
    for (const [position, row] of made) {
      if (position < first || position >= last) {
        row.remove();
        made.delete(position);
      }
    }
    for (let position = first; position < last; position += 1) {
      if (made.has(position)) continue;
      const row = makeRow(shown[position]);
      row.style.top = `${position * HEIGHT}px`;
      made.set(position, row);
      byId("spacer").append(row);
    }
  }

  function makeRow(e) {
    const isSkipped = e.n === null;
    const row = element(isSkipped ? "div" : "a", { class: "row" });
    row.classList.toggle("plain", !index.cameras.length);
    row.classList.toggle("skipped", isSkipped);
    row.classList.toggle("chosen", !isSkipped && e.n === chosen);
    if (!isSkipped) {
      row.href = `#${noun()}=${e.n}`;
      row.dataset.episode = e.n;
      row.onclick = (event) => {
        if (event.ctrlKey || event.metaKey || event.shiftKey) return;
        event.preventDefault();
        onOpen(e.n);
      };
    }
    if (index.cameras.length) {
      row.append(isSkipped ? element("span") : element("img", { src: thumbnailUrl(e.n), alt: "", loading: "lazy" }));
    }
    const object = noun() === "decision" ? `${e.task}: ${e.object}` : e.object;
    const title = isSkipped ? `seed ${e.seed}, skipped` : object || e.instruction || `seed ${e.seed ?? "unknown"}`;
    const attempts = e.attempts > 1 ? `${e.attempts} attempts` : "";
    const failed = e.stages.length && noun() === "episode" ? `failed at ${e.stages.join(", ").replaceAll("_", " ")}` : "";
    const second = isSkipped ? [attempts, failed].filter(Boolean).join(", ") : e.damage || e.instruction;
    const what = element("div", { class: "what", title: second }, element("div", { textContent: title }), element("div", { textContent: second }));
    const outcome = element("div", { class: "outcome", title: [attempts, failed].filter(Boolean).join(", ") });
    if (e.success !== null) outcome.append(element("span", { class: e.success ? "good" : "bad", textContent: e.success ? "success" : "failure" }));
    if (e.damage) outcome.append(element("div", { class: "bad", textContent: "damaged", title: e.damage }));
    else if (attempts && !isSkipped) outcome.append(element("div", { class: "faint", textContent: attempts }));
    row.append(
      element("span", { class: "number", textContent: isSkipped ? "" : e.n }), what,
      element("span", { class: "number", textContent: e.steps || "" }), outcome
    );
    return row;
  }

  function choose(number) {
    chosen = number;
    for (const row of made.values()) row.classList.toggle("chosen", row.dataset.episode === String(number));
    const position = shown.findIndex((e) => e.n === number);
    const box = byId("rows");
    if (position < 0) return;
    const top = position * HEIGHT;
    const above = top - box.scrollTop;
    const below = top + HEIGHT - box.scrollTop - box.clientHeight;
    if (above < -HEIGHT || below > HEIGHT) box.scrollTop = top - box.clientHeight / 2; // far away: scroll to the middle
    else if (above < 0) box.scrollTop = top;
    else if (below > 0) box.scrollTop += below;
  }

  // The number of the episode some rows further, among those that pass the filters.
  function neighbour(number, by) {
    const real = shown.filter((e) => e.n !== null);
    const position = real.findIndex((e) => e.n === number);
    const next = position < 0 ? real[0] : real[position + by];
    return next ? next.n : null;
  }

  const find = (number) => index.episodes.find((e) => e.n === number);
  const first = () => (shown.find((e) => e.n !== null) || { n: null }).n;
  return { start, choose, neighbour, find, first };
})();
