"use strict";
// The current step: images, timeline, playback.

robocas.player = (() => {
  const { byId, element, imageUrl, seriesColour } = robocas;
  const AHEAD = 3; // images fetched ahead while playing
  let index = null;
  let episode = null;
  let step = 0;
  let kind = "rgb";
  let playing = false;
  let onStep = () => {};
  let frames = []; // {camera, img, empty, wanted}

  function start(content, stepped) {
    index = content;
    onStep = stepped;
    frames = index.cameras.map((camera) => {
      const name = camera.replace(/^observation\.images\./, "").replaceAll("_", " ");
      const img = element("img", { alt: name });
      const empty = element("span", { class: "faint", textContent: "no image" });
      const box = element("figure", {}, element("div", { class: "frame" }, img, empty), element("figcaption", { textContent: name }));
      byId("cameras").append(box);
      return { camera, img, empty, wanted: "" };
    });
    byId("cameras").hidden = !frames.length;
    byId("views").hidden = !(frames.length && index.depth);
    const click = (id, action) => {
      byId(id).onclick = () => {
        action();
        byId(id).blur(); // so that Space still plays
      };
    };
    click("b-first", () => go(0));
    click("b-back", () => go(step - 1));
    click("b-next", () => go(step + 1));
    click("b-last", () => go(Infinity));
    click("b-play", toggle);
    click("v-rgb", () => view("rgb"));
    click("v-depth", () => view("depth"));
    byId("scrub").oninput = () => go(Number(byId("scrub").value));
  }

  function show(content, at) {
    pause();
    episode = content;
    byId("scrub").max = episode.steps - 1;
    byId("goals").replaceChildren(
      ...episode.subgoals.map((goal, number) => {
        const button = element("button", { textContent: goal.type, title: `${goal.text} (steps ${goal.first} to ${goal.last})` });
        button.style.left = `${(goal.first / episode.steps) * 100}%`;
        button.style.width = `calc(${((goal.last - goal.first + 1) / episode.steps) * 100}% - 2px)`;
        button.style.borderBottomColor = seriesColour(number);
        button.onclick = () => {
          go(goal.first);
          button.blur();
        };
        return button;
      }),
      element("i")
    );
    byId("goals").hidden = !episode.subgoals.length;
    for (const frame of frames) frame.wanted = "";
    go(at);
  }

  function go(to) {
    if (!episode) return;
    const last = episode.steps - 1;
    step = Math.max(0, Math.min(last, Math.round(to) || 0)); // NaN in a URL: the first step
    byId("scrub").value = step;
    byId("clock").textContent = `step ${step} / ${last}   ${episode.times[step].toFixed(2)} s`;
    const now = episode.subgoals.findIndex((goal) => goal.first <= step && step <= goal.last);
    byId("goal").textContent = now < 0 ? "" : episode.subgoals[now].text;
    byId("goal").title = byId("goal").textContent;
    [...byId("goals").querySelectorAll("button")].forEach((button, number) => button.classList.toggle("now", number === now));
    byId("goals").querySelector("i").style.left = `${((step + 0.5) / episode.steps) * 100}%`;
    images();
    onStep(step);
  }

  // An image is shown once it is decoded, if the step is still current: no flicker.
  function images() {
    for (const frame of frames) {
      const url = imageUrl(episode.n, frame.camera, kind, step);
      if (frame.wanted === url) continue;
      frame.wanted = url;
      const next = new Image();
      const done = (shown) => {
        if (frame.wanted !== url) return;
        frame.img.hidden = !shown;
        frame.empty.hidden = shown;
        if (shown) frame.img.src = url;
        frame.img.dataset.step = shown ? step : "";
        frame.loaded = url;
      };
      next.onload = () => done(true);
      next.onerror = () => done(false);
      next.src = url;
    }
    const ahead = playing ? AHEAD : 1;
    for (let by = 1; by <= ahead && step + by < episode.steps; by += 1) {
      for (const frame of frames) new Image().src = imageUrl(episode.n, frame.camera, kind, step + by);
    }
  }

  function view(wanted) {
    if (!index.depth) return;
    kind = wanted;
    byId("v-rgb").setAttribute("aria-pressed", kind === "rgb");
    byId("v-depth").setAttribute("aria-pressed", kind === "depth");
    if (episode) images();
  }

  function toggle() {
    if (playing) return pause();
    if (!episode) return undefined;
    if (step >= episode.steps - 1) go(0);
    playing = true;
    byId("b-play").textContent = "Pause";
    let time = episode.times[step];
    let before = performance.now();
    const tick = (now) => {
      if (!playing) return;
      const ready = frames.every((frame) => frame.loaded === frame.wanted);
      if (ready) time += ((now - before) / 1000) * Number(byId("speed").value); // slow images pause the clock
      before = now;
      let to = step;
      while (to < episode.steps - 1 && episode.times[to + 1] <= time) to += 1;
      if (to !== step) go(to);
      if (step >= episode.steps - 1) pause();
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
    return undefined;
  }

  function pause() {
    playing = false;
    byId("b-play").textContent = "Play";
  }

  return {
    start, show, go, toggle, pause, view,
    by: (steps) => go(step + steps),
    flip: () => view(kind === "rgb" ? "depth" : "rgb"),
    step: () => step,
    recolour: () => [...byId("goals").querySelectorAll("button")].forEach((b, i) => { b.style.borderBottomColor = seriesColour(i); }),
  };
})();
