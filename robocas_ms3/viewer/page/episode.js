"use strict";
// One episode: instruction, summary, facts and failed attempts.

robocas.episode = (() => {
  const { byId, element, player, plots, space, table } = robocas;
  let opened = null;
  let wanted = null;

  async function open(number, step = 0) {
    wanted = number;
    if (opened === number) return player.go(step);
    let content;
    try {
      content = await robocas.load(`episode_${number}`);
    } catch (error) {
      const entry = table.find(number);
      const why = entry && (entry.damage ? `: ${entry.damage}.` : ": it is damaged or missing.");
      if (wanted === number) fail(why ? `Episode ${number} can't be shown${why}` : `There is no episode ${number}.`);
      return undefined;
    }
    if (wanted !== number) return undefined; // another episode was opened
    opened = number;
    byId("message").hidden = true;
    byId("episode").hidden = false;
    describe(content);
    table.choose(number);
    space.show(content);
    plots.show(content, player.go);
    player.show(content, step);
    return undefined;
  }

  function fail(text) {
    opened = null;
    player.pause();
    table.choose(null);
    byId("episode").hidden = true;
    byId("message").hidden = false;
    byId("message").textContent = text;
  }

  function describe(content) {
    const entry = table.find(content.n) || {};
    document.title = `Episode ${content.n}: ${content.instruction || "robocas view"}`;
    byId("instruction").textContent = content.instruction || `Episode ${content.n}`;
    const seconds = content.times[content.times.length - 1] || 0;
    const parts = [
      `Episode ${content.n}`,
      (entry.task || "").replaceAll("_", " "),
      entry.seed === null || entry.seed === undefined ? "" : `seed ${entry.seed}`,
      `${content.steps} steps, ${seconds.toFixed(1)} s`,
      entry.split,
      entry.attempts > 1 ? `${entry.attempts} attempts` : "",
    ].filter(Boolean);
    byId("summary").replaceChildren(parts.join(" \u00b7 "));
    if (entry.success !== null && entry.success !== undefined) {
      byId("summary").append(" \u00b7 ", element("span", { class: entry.success ? "good" : "bad", textContent: entry.success ? "success" : "failure" }));
    }
    byId("damage").hidden = !entry.damage;
    byId("damage").textContent = entry.damage ? `Not shown (damaged): ${entry.damage}` : "";
    byId("facts").replaceChildren(
      ...Object.entries(content.facts).flatMap(([name, value]) => [
        element("dt", { textContent: name.replaceAll("_", " ") }),
        element("dd", { textContent: typeof value === "object" ? JSON.stringify(value) : String(value) }),
      ])
    );
    const lines = content.failures.map((f) => element("li", {}, `${f.stage.replaceAll("_", " ")}: ${f.reason.replaceAll("_", " ")} `, element("span", { class: "faint", textContent: f.text })));
    byId("failures").replaceChildren(...(lines.length ? [element("h3", { textContent: "Failed attempts" }), element("ul", {}, ...lines)] : []));
  }

  return { open, fail, number: () => opened };
})();
