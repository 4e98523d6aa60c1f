"use strict";
// Data are scripts that call robocas.put(name, content), from the server or from disk.

const robocas = (() => {
  const store = new Map();
  const waiting = new Map();
  const KEEP = 12; // episodes in memory
  let noun = "episode"; // of a row of the table: "episode" or "decision"
  let query = ""; // of image URLs: browsers cache images, and another server may use the same port

  function put(name, content) {
    store.set(name, content);
    if (name === "index" && content.version) query = `?${content.version}`;
    if (name === "index" && content.decisions) noun = "decision";
    const episodes = [...store.keys()].filter((key) => key !== "index");
    for (const key of episodes.slice(0, Math.max(0, episodes.length - KEEP))) store.delete(key);
  }

  function load(name) {
    if (store.has(name)) return Promise.resolve(store.get(name));
    if (waiting.has(name)) return waiting.get(name);
    const promise = new Promise((resolve, reject) => {
      const script = document.createElement("script");
      script.src = `data/${name}.js`;
      script.onload = () => (store.has(name) ? resolve(store.get(name)) : reject(new Error(`${name}: no content`)));
      script.onerror = () => reject(new Error(`${name} can't be loaded`));
      document.head.append(script);
      script.addEventListener("load", () => script.remove());
    }).finally(() => waiting.delete(name));
    waiting.set(name, promise);
    return promise;
  }

  const imageUrl = (episode, camera, kind, step) => `images/${episode}/${camera}/${kind}/${step}.jpg${query}`;
  const thumbnailUrl = (episode) => `thumbnails/${episode}.jpg${query}`;
  const byId = (id) => document.getElementById(id);

  function element(tag, attributes = {}, ...children) {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "class") made.className = value;
      else if (name in made) made[name] = value;
      else made.setAttribute(name, value);
    }
    made.append(...children);
    return made;
  }

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  }

  const seriesColour = (index) => colour(`s${index % 7}`);

  // A canvas's drawing context with its bitmap as large as it is shown; units are CSS pixels.
  function context(canvas) {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const ctx = canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    return { ctx, width, height };
  }

  return { noun: () => noun, put, load, imageUrl, thumbnailUrl, byId, element, colour, seriesColour, context };
})();
