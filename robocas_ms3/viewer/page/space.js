"use strict";
// The 3-D view: paths of the TCP and the objects, in the world's frame (z up).

robocas.space = (() => {
  const { byId, colour, seriesColour, context } = robocas;
  const HOME = { turn: -2.1, tilt: 0.5, zoom: 1 };
  let view = { ...HOME };
  let trace = null;
  let goals = [];
  let step = 0;
  let centre = [0, 0, 0];
  let radius = 1;
  let floor = 0;

  function start() {
    const canvas = byId("space");
    let drag = null;
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      drag = [event.clientX, event.clientY];
    };
    canvas.onpointermove = (event) => {
      if (!drag) return;
      view.turn -= (event.clientX - drag[0]) * 0.01;
      view.tilt = Math.min(1.57, Math.max(-0.2, view.tilt + (event.clientY - drag[1]) * 0.01));
      drag = [event.clientX, event.clientY];
      draw();
    };
    canvas.onpointerup = canvas.onpointercancel = () => { drag = null; };
    canvas.ondblclick = () => { view = { ...HOME }; draw(); };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      view.zoom = Math.min(8, Math.max(0.4, view.zoom * Math.exp(-event.deltaY * 0.001)));
      draw();
    }, { passive: false });
  }

  function show(episode) {
    trace = episode.trace;
    goals = episode.subgoals;
    byId("space-box").hidden = !trace;
    if (!trace) return;
    byId("space-note").textContent = trace.objects.length ? (trace.moving ? "" : "objects at the start") : "";
    const points = [...trace.tcp, ...trace.objects.flatMap((thing) => thing.path)];
    const low = [0, 1, 2].map((axis) => points.reduce((a, p) => Math.min(a, p[axis]), Infinity));
    const high = [0, 1, 2].map((axis) => points.reduce((a, p) => Math.max(a, p[axis]), -Infinity));
    centre = low.map((value, axis) => (value + high[axis]) / 2);
    radius = Math.max(0.15, Math.hypot(...low.map((value, axis) => high[axis] - value)) / 2);
    floor = low[2] - 0.02;
  }

  // Project to pixels: rotation about z, tilt, perspective from four radii away.
  function project([x, y, z], width, height) {
    const [dx, dy, dz] = [x - centre[0], y - centre[1], z - centre[2]];
    const [cos, sin] = [Math.cos(view.turn), Math.sin(view.turn)];
    const right = -sin * dx + cos * dy;
    const away = -(cos * dx + sin * dy);
    const [ct, st] = [Math.cos(view.tilt), Math.sin(view.tilt)];
    const up = ct * dz + st * away;
    const depth = 4 * radius + ct * away - st * dz;
    const scale = (Math.min(width, height) * 2.15 * view.zoom) / Math.max(depth, radius / 2);
    return [width / 2 + right * scale, height / 2 - up * scale, depth];
  }

  function draw() {
    if (!trace) return;
    const { ctx, width, height } = context(byId("space"));
    const at = (point) => project(point, width, height);
    grid(ctx, at);
    ctx.lineJoin = ctx.lineCap = "round";
    ctx.font = "11px system-ui, sans-serif";
    const labels = [];
    for (const thing of trace.objects) {
      const now = thing.path[Math.min(step, thing.path.length - 1)];
      const ink = thing.target ? colour("bad") : colour("faint");
      if (thing.path.length > 1) line(ctx, thing.path.map(at), ink, thing.target ? 1.6 : 1, 0.5);
      const [x, y] = at(now);
      line(ctx, [[x, y], at([now[0], now[1], floor])], ink, 1, 0.35);
      ctx.fillStyle = ink;
      ctx.beginPath();
      ctx.arc(x, y, thing.target ? 5 : 3.5, 0, 2 * Math.PI);
      ctx.fill();
      labels.push([thing.name, x + 7, y + 3, thing.target, thing.name === "basket"]);
    }
    tcp(ctx, at);
    label(ctx, labels, width);
    axes(ctx, height);
  }

  function grid(ctx, at) {
    const cell = radius > 2 ? 0.5 : 0.1;
    const [x0, x1, y0, y1] = [0, 0, 1, 1].map((axis, side) => Math.round((centre[axis] + (side % 2 ? 1 : -1) * radius) / cell) * cell);
    const count = (low, high) => Math.round((high - low) / cell);
    for (let i = 0; i <= count(x0, x1); i += 1) line(ctx, [at([x0 + i * cell, y0, floor]), at([x0 + i * cell, y1, floor])], colour("line"), 1, 1);
    for (let i = 0; i <= count(y0, y1); i += 1) line(ctx, [at([x0, y0 + i * cell, floor]), at([x1, y0 + i * cell, floor])], colour("line"), 1, 1);
    ctx.fillStyle = colour("faint");
    ctx.font = "11px system-ui, sans-serif";
    ctx.fillText(`grid ${cell * 100} cm, at z = ${floor.toFixed(2)} m`, 8, 16);
  }

  // The path in the colours of the sub-goals: past strong, future faint.
  function tcp(ctx, at) {
    const points = trace.tcp.map(at);
    const parts = goals.length ? goals : [{ first: 0, last: points.length - 1 }];
    parts.forEach((goal, index) => {
      const end = Math.min(goal.last + 2, points.length);
      const done = Math.max(goal.first, Math.min(end, step + 1));
      line(ctx, points.slice(Math.max(goal.first, done - 1), end), seriesColour(index), 1.5, 0.3);
      line(ctx, points.slice(goal.first, done), seriesColour(index), 2.4, 1);
    });
    const now = trace.tcp[step];
    const [x, y] = points[step];
    line(ctx, [[x, y], at([now[0], now[1], floor])], colour("cursor"), 1, 0.4);
    if (trace.approach) {
      const back = now.map((value, axis) => value - 0.12 * trace.approach[step][axis]);
      line(ctx, [[x, y], at(back)], colour("cursor"), 4, 0.9);
    }
    ctx.fillStyle = colour("cursor");
    ctx.beginPath();
    ctx.arc(x, y, 5, 0, 2 * Math.PI);
    ctx.fill();
  }

  function line(ctx, points, ink, width, alpha) {
    if (points.length < 2) return;
    ctx.globalAlpha = alpha;
    ctx.strokeStyle = ink;
    ctx.lineWidth = width;
    ctx.beginPath();
    points.forEach(([x, y], index) => (index ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
    ctx.stroke();
    ctx.globalAlpha = 1;
  }

  // Names, target and basket first; overlapping names are omitted.
  function label(ctx, labels, width) {
    const taken = labels.map(([, x, y]) => [x - 11, y - 7, x - 3, y + 1]); // the dots
    for (const [text, x, y, strong] of labels.sort((a, b) => b[3] - a[3] || b[4] - a[4])) {
      ctx.font = `${strong ? "600 12px" : "11px"} system-ui, sans-serif`;
      const size = ctx.measureText(text).width;
      const [left, base] = place(x, y, size, width);
      const box = [left, base - 10, left + size, base + 3];
      if (!strong && taken.some((t) => box[0] < t[2] && box[2] > t[0] && box[1] < t[3] && box[3] > t[1])) continue;
      taken.push(box);
      ctx.fillStyle = strong ? colour("bad") : colour("faint");
      ctx.fillText(text, left, base);
    }
  }

  // Right of the dot, else left of it, else above.
  function place(x, y, size, width) {
    if (x + size <= width - 4) return [x, y];
    return x - size - 14 >= 3 ? [x - size - 14, y] : [Math.max(3, width - 4 - size), y - 13];
  }

  function axes(ctx, height) {
    const [cos, sin] = [Math.cos(view.turn), Math.sin(view.turn)];
    const [ct, st] = [Math.cos(view.tilt), Math.sin(view.tilt)];
    [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["z", [0, 0, 1]]].forEach(([name, [x, y, z]]) => {
      const right = -sin * x + cos * y;
      const up = ct * z - st * (cos * x + sin * y);
      const [ox, oy] = [34, height - 30];
      line(ctx, [[ox, oy], [ox + 20 * right, oy - 20 * up]], colour("faint"), 1.5, 1);
      ctx.fillStyle = colour("faint");
      ctx.fillText(name, ox + 27 * right - 3, oy - 27 * up + 3);
    });
  }

  function cursor(to) {
    step = to;
    draw();
  }

  return { start, show, cursor };
})();
