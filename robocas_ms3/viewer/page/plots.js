"use strict";
// Plots over the steps of an episode, with a cursor; a click or a drag seeks.

robocas.plots = (() => {
  const { byId, element, seriesColour, colour, context } = robocas;
  const LEFT = 46, RIGHT = 4, TOP = 6, BOTTOM = 6;
  let plots = [];
  let goals = [];
  let steps = 0;
  let onSeek = () => {};

  function show(episode, seek) {
    steps = episode.steps;
    goals = episode.subgoals;
    onSeek = seek;
    plots = episode.plots.map(make);
    byId("plots").replaceChildren(...plots.map((plot) => plot.box));
    redraw();
  }

  function make(content) {
    const canvas = element("canvas", { "aria-label": content.title });
    const legend = element("div", { class: "legend" });
    const values = content.series.map((series) => {
      const value = element("b");
      legend.append(element("span", {}, element("i"), `${series.name} `, value));
      return value;
    });
    const title = element("h3", {}, content.title, element("span", { class: "faint", textContent: content.unit ? `  ${content.unit}` : "" }));
    const box = element("div", { class: "plot" }, title, canvas, legend);
    const all = content.series.flatMap((series) => series.values.filter((v) => v !== null));
    let low = all.reduce((a, b) => Math.min(a, b), Infinity);
    let high = all.reduce((a, b) => Math.max(a, b), -Infinity);
    if (!(low < high)) [low, high] = Number.isFinite(low) ? [low - 1, high + 1] : [-1, 1];
    const margin = (high - low) * 0.06;
    const plot = { content, canvas, legend, values, box, low: low - margin, high: high + margin, cache: null };
    const seek = (event) => {
      const area = canvas.getBoundingClientRect();
      const fraction = (event.clientX - area.left - LEFT) / (area.width - LEFT - RIGHT);
      onSeek(Math.round(fraction * (steps - 1)));
    };
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      seek(event);
      canvas.onpointermove = seek;
    };
    canvas.onpointerup = () => { canvas.onpointermove = null; };
    return plot;
  }

  // Lines change only with size and colours; they are cached as a bitmap.
  function lines(plot, width, height) {
    const ratio = window.devicePixelRatio || 1;
    const sheet = document.createElement("canvas");
    sheet.width = Math.round(width * ratio);
    sheet.height = Math.round(height * ratio);
    const ctx = sheet.getContext("2d");
    ctx.scale(ratio, ratio);
    const x = (step) => LEFT + (step / Math.max(1, steps - 1)) * (width - LEFT - RIGHT);
    const y = (value) => TOP + ((plot.high - value) / (plot.high - plot.low)) * (height - TOP - BOTTOM);
    ctx.fillStyle = colour("panel");
    ctx.fillRect(LEFT, 0, width - LEFT - RIGHT, height);
    ctx.strokeStyle = ctx.fillStyle = colour("line");
    ctx.lineWidth = 1;
    ctx.font = "11px system-ui, sans-serif";
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    for (const tick of ticks(plot.low, plot.high)) {
      ctx.strokeStyle = colour("line");
      ctx.beginPath();
      ctx.moveTo(LEFT, Math.round(y(tick)) + 0.5);
      ctx.lineTo(width - RIGHT, Math.round(y(tick)) + 0.5);
      ctx.stroke();
      ctx.fillStyle = colour("faint");
      ctx.fillText(String(+tick.toPrecision(6)), LEFT - 5, y(tick));
    }
    ctx.strokeStyle = colour("faint");
    ctx.setLineDash([2, 3]);
    for (const goal of goals.slice(1)) {
      ctx.beginPath();
      ctx.moveTo(x(goal.first), 0);
      ctx.lineTo(x(goal.first), height);
      ctx.stroke();
    }
    ctx.setLineDash([]);
    ctx.lineWidth = 1.4;
    ctx.lineJoin = "round";
    plot.content.series.forEach((series, index) => {
      ctx.strokeStyle = seriesColour(index);
      ctx.beginPath();
      let pen = false;
      let before = 0;
      series.values.forEach((value, step) => {
        if (value === null) { pen = false; return; }
        if (pen && plot.content.steps) ctx.lineTo(x(step), y(before));
        if (pen) ctx.lineTo(x(step), y(value));
        else ctx.moveTo(x(step), y(value));
        pen = true;
        before = value;
      });
      ctx.stroke();
    });
    return { sheet, width, height, ratio, x, y };
  }

  function ticks(low, high) {
    const rough = (high - low) / 4;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
    const found = [];
    for (let tick = Math.ceil(low / step) * step; tick <= high; tick += step) found.push(Math.abs(tick) < step / 1e6 ? 0 : tick);
    return found;
  }

  function cursor(step) {
    for (const plot of plots) {
      const { ctx, width, height } = context(plot.canvas);
      if (!width || !height) continue;
      const old = plot.cache;
      if (!old || old.width !== width || old.height !== height || old.ratio !== (window.devicePixelRatio || 1)) plot.cache = lines(plot, width, height);
      const { sheet, x, y } = plot.cache;
      ctx.drawImage(sheet, 0, 0, width, height);
      ctx.strokeStyle = colour("cursor");
      ctx.lineWidth = 1;
      ctx.beginPath();
      ctx.moveTo(x(step), 0);
      ctx.lineTo(x(step), height);
      ctx.stroke();
      plot.content.series.forEach((series, index) => {
        const value = series.values[step];
        plot.values[index].textContent = value === null || value === undefined ? "none" : format(value);
        if (value === null || value === undefined) return;
        ctx.fillStyle = seriesColour(index);
        ctx.beginPath();
        ctx.arc(x(step), y(value), 2.6, 0, 2 * Math.PI);
        ctx.fill();
      });
    }
  }

  const format = (value) => value.toFixed(Math.abs(value) >= 100 ? 0 : Math.abs(value) >= 10 ? 1 : 3);

  // Redraw after a change of size or colours.
  function redraw() {
    for (const plot of plots) {
      plot.cache = null;
      [...plot.legend.querySelectorAll("i")].forEach((mark, index) => { mark.style.background = seriesColour(index); });
    }
  }

  return { show, cursor, redraw };
})();
