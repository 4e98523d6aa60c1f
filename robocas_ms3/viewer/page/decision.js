"use strict";
// One decision: its candidates in an image or in a plot from above, and a table of their outcomes.

robocas.decision = (() => {
  const { byId, element, imageUrl, table } = robocas;
  const SVG = "http://www.w3.org/2000/svg";
  const COLUMNS = [["n", "#"], ["what", "Candidate"], ["outcome", "Outcome"], ["benefit", "Benefit s"], ["seconds", "Time s"]];
  const VALUES = [
    ["obstacles", "Obstacles of the target", change], ["free_grasps", "Free grasps of the target", change],
    ["hidden_fraction", "Hidden share of the target", (v) => change(v.map((share) => `${Math.round(100 * share)} %`))],
    ["target_mm", "Displacement of the target", (v) => `${v.toFixed(0)} mm`], ["disturbed", "Disturbed objects", String],
    ["fallen", "Fallen objects", String], ["moves_to_grasp", "Moves until the grasp", (v) => (v < 0 ? null : String(v))],
    ["source", "Origin", (v) => v.replaceAll("_", " ")], ["failure", "Failure", (v) => v.replaceAll("_", " ") || null],
  ];
  let index = null;
  let decision = null;
  let wanted = null;
  let view = ""; // name
  let picked = false; // whether the view was chosen by hand
  let zoom = true;
  let depth = false;
  let chosen = null; // candidate that was clicked
  let sort = { key: "n", down: false };
  const hidden = new Set(); // outcomes

  function start(content) {
    index = content;
    byId("d-zoom").onclick = () => toggle("zoom");
    byId("d-depth").onclick = () => toggle("depth");
    byId("d-depth").hidden = !index.depth;
    byId("keys").hidden = true;
    byId("d-keys").hidden = false;
    for (const [name, colour] of Object.entries(index.outcomes)) document.documentElement.style.setProperty(`--o-${name}`, colour);
  }

  async function open(number) {
    wanted = number;
    if (decision && decision.n === number) return undefined;
    let content;
    try {
      content = await robocas.load(`episode_${number}`);
    } catch (error) {
      if (wanted === number) fail(table.find(number) ? `Decision ${number} can't be shown: it is damaged or missing.` : `There is no decision ${number}.`);
      return undefined;
    }
    if (wanted !== number) return undefined;
    decision = content;
    chosen = null;
    if (!picked || !decision.views.some((v) => v.name === view)) view = decision.best_view;
    byId("message").hidden = true;
    byId("decision").hidden = false;
    describe();
    table.choose(number);
    draw();
    return undefined;
  }

  function fail(text) {
    decision = null;
    table.choose(null);
    byId("decision").hidden = true;
    byId("message").hidden = false;
    byId("message").textContent = text;
  }

  function describe() {
    document.title = `Decision ${decision.n}: ${decision.instruction}`;
    byId("d-instruction").textContent = decision.instruction;
    const parts = [`Decision ${decision.n}`, decision.kind, `seed ${decision.seed}`, `number ${decision.decision} of the seed, step ${decision.step}`, `${decision.candidates.length} candidates`];
    byId("d-summary").textContent = parts.join(" \u00b7 ");
    byId("d-facts").replaceChildren(...pairs(Object.entries(decision.facts)));
  }

  const pairs = (entries) => entries.flatMap(([name, value]) => [element("dt", { textContent: name }), element("dd", { textContent: String(value) })]);

  function draw() {
    const press = (id, on) => byId(id).setAttribute("aria-pressed", on);
    press("d-zoom", zoom);
    press("d-depth", depth);
    byId("d-views").replaceChildren(
      ...decision.views.map(({ name }) => {
        const button = element("button", { textContent: name.replaceAll("_", " "), "aria-pressed": name === view });
        button.onclick = () => pick(name);
        return button;
      })
    );
    byId("d-views").hidden = decision.views.length < 2;
    byId("d-outcomes").replaceChildren(
      ...Object.keys(index.outcomes).reverse().map((name) => {
        const count = decision.candidates.filter((c) => c.outcome === name).length;
        const button = element("button", { "aria-pressed": !hidden.has(name), title: `Show or hide: ${name}` }, swatch(name), `${name} ${count}`);
        button.onclick = () => {
          if (!hidden.delete(name)) hidden.add(name);
          draw();
        };
        return button;
      })
    );
    drawImage();
    rows();
    highlight(chosen);
  }

  const swatch = (outcome) => {
    const made = element("i");
    made.style.background = `var(--o-${outcome})`;
    return made;
  };

  function svg(tag, attributes, ...children) {
    const made = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
  }

  function drawImage() {
    const shown = decision.views.find((v) => v.name === view);
    const isCamera = index.cameras.includes(view);
    const [width, height] = shown.size;
    const region = zoom ? shown.region : [0, 0, width, height];
    const image = byId("d-image");
    image.setAttribute("viewBox", region.join(" "));
    image.classList.toggle("plot", !isCamera);
    const parts = isCamera ? [svg("image", { href: imageUrl(decision.n, view, depth ? "depth" : "rgb", 0), width, height })] : [];
    for (const thing of shown.objects) { // lowest first
      if (!thing.outline.length || (isCamera && !thing.target)) continue;
      const outline = svg("polygon", { points: thing.outline.join(" "), class: thing.target ? "object target" : "object" });
      outline.append(svg("title", {}, document.createTextNode(thing.name)));
      parts.push(outline);
    }
    const order = Object.keys(index.outcomes);
    const rank = (c) => order.indexOf(c.outcome) + (c.chosen ? order.length : 0);
    for (const candidate of [...decision.candidates].sort((a, b) => rank(a) - rank(b))) {
      if (hidden.has(candidate.outcome)) continue;
      const group = svg("g", { class: candidate.chosen ? "candidate is-chosen" : "candidate", "data-n": candidate.n });
      for (const edge of [true, false]) {
        for (const line of shown.candidates[candidate.n]) {
          const made = svg("polyline", { points: line.points.join(" "), class: edge ? "edge" : "ink" });
          if (line.dashed) made.classList.add("dashed");
          if (!edge) made.style.stroke = `var(--o-${candidate.outcome})`;
          group.append(made);
        }
      }
      group.append(svg("title", {}, document.createTextNode(`${candidate.n}: ${what(candidate)}, ${candidate.outcome}`)));
      link(group, candidate.n);
      parts.push(group);
    }
    const size = region[2] / 48;
    for (const thing of shown.objects) {
      if (!thing.pixel || (isCamera && !thing.target)) continue;
      const below = isCamera ? Math.max(thing.pixel[1], ...thing.outline.map((point) => point[1])) + 1.2 * size : thing.pixel[1];
      const label = svg("text", { x: thing.pixel[0], y: below, "font-size": size, class: thing.target ? "target" : "" });
      label.textContent = thing.name;
      parts.push(label);
    }
    image.replaceChildren(...parts);
  }

  const what = (c) => `${c.primitive} ${c.object}`.trim();

  function rows() {
    const head = element("tr", {});
    for (const [key, title] of COLUMNS) {
      const arrow = sort.key === key ? (sort.down ? " \u2193" : " \u2191") : "";
      const button = element("button", { textContent: title + arrow });
      button.onclick = () => {
        sort = { key, down: sort.key === key && !sort.down };
        draw();
      };
      head.append(element("th", {}, button));
    }
    byId("d-list").querySelector("thead").replaceChildren(head);
    const order = Object.keys(index.outcomes);
    const value = (c) => ({ what: what(c), outcome: -order.indexOf(c.outcome) })[sort.key] ?? c[sort.key] ?? -Infinity;
    const sorted = [...decision.candidates].sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      return x === y ? a.n - b.n : (x < y ? -1 : 1) * (sort.down ? -1 : 1);
    });
    byId("d-rows").replaceChildren(
      ...sorted.filter((c) => !hidden.has(c.outcome)).map((c) => {
        const state = c.failure ? c.failure.replaceAll("_", " ") : c.held ? "held" : "";
        const row = element("tr", { class: c.chosen ? "is-chosen" : "", "data-n": c.n },
          element("td", { class: "number", textContent: c.n }),
          element("td", {}, element("div", { textContent: what(c) }), element("div", { class: "faint", textContent: c.chosen ? `${c.source.replaceAll("_", " ")}, chosen` : c.source.replaceAll("_", " ") })),
          element("td", {}, element("div", {}, swatch(c.outcome), c.outcome), element("div", { class: "faint", textContent: state })),
          element("td", { class: "number", textContent: c.benefit === null || c.outcome === "infeasible" ? "" : signed(c.benefit.toFixed(1)) }),
          element("td", { class: "number", textContent: c.outcome === "infeasible" ? "" : c.seconds.toFixed(1) }));
        link(row, c.n);
        return row;
      })
    );
  }

  function change([before, after]) {
    return before === after ? String(after) : `${before} \u2192 ${after}`;
  }

  function signed(value) {
    return Number(value) > 0 ? `+${value}` : String(value);
  }

  // Pointing at a candidate highlights it in the image and in the table; a click keeps it highlighted.
  function link(node, n) {
    node.addEventListener("pointerenter", () => highlight(n));
    node.addEventListener("pointerleave", () => highlight(chosen));
    node.addEventListener("click", () => select(chosen === n ? null : n));
  }

  function select(n) {
    chosen = n;
    highlight(n);
    const row = n === null ? null : byId("d-rows").querySelector(`[data-n="${n}"]`);
    if (row) row.scrollIntoView({ block: "nearest" });
  }

  function highlight(n) {
    byId("d-image").classList.toggle("has-focus", n !== null);
    for (const node of [...byId("d-image").querySelectorAll(".candidate"), ...byId("d-rows").children]) {
      node.classList.toggle("focus", n !== null && node.dataset.n === String(n));
    }
    const candidate = n === null ? null : decision.candidates[n];
    const entries = candidate
      ? VALUES.filter(([key]) => candidate[key] !== null && candidate[key] !== undefined).map(([key, title, format]) => [title, format(candidate[key])])
      : [];
    byId("d-candidate").replaceChildren(...pairs([...(candidate ? [["Candidate", `${n}: ${what(candidate)}`]] : []), ...entries.filter(([, text]) => text !== null)]));
  }

  // The candidate some rows further in the table.
  function by(count) {
    const numbers = [...byId("d-rows").children].map((row) => Number(row.dataset.n));
    const position = chosen === null ? (count > 0 ? -1 : 0) : numbers.indexOf(chosen);
    if (numbers.length) select(numbers[(position + count + numbers.length) % numbers.length]);
  }

  function toggle(name) {
    if (name === "zoom") zoom = !zoom;
    else if (index.depth) depth = !depth;
    if (decision) draw();
  }

  function cycle() {
    if (!decision) return;
    const names = decision.views.map((v) => v.name);
    pick(names[(names.indexOf(view) + 1) % names.length]);
  }

  function pick(name) {
    view = name;
    picked = true;
    draw();
  }

  const KEYS = {
    ArrowLeft: () => by(-1),
    ArrowRight: () => by(1),
    Escape: () => select(null),
    z: () => toggle("zoom"),
    d: () => toggle("depth"),
    v: cycle,
  };

  return { start, open, fail, KEYS, number: () => (decision ? decision.n : null) };
})();
