// Software renderer for the points and lines of every canvas.scene, in perspective; rotated, moved and zoomed by
// mouse, touch, keys and buttons. Positions come as unsigned 16-bit fractions of their bounding box.
"use strict";
for (const canvas of document.querySelectorAll("canvas.scene")) show(canvas);

function show(canvas) {
  const scene = JSON.parse(canvas.dataset.scene), [low, high] = scene.box;
  const middle = low.map((v, i) => (v + high[i]) / 2), half = low.map((v, i) => (high[i] - v) / 2);
  const place = text => {  // meters from the middle of the box
    const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0)), numbers = new Uint16Array(bytes.buffer);
    return Float32Array.from(numbers, (v, i) => (v / 32767.5 - 1) * half[i % 3]);
  };
  const points = place(scene.points), count = points.length / 3;
  const lines = scene.lines.map(line => ({...line, points: place(line.points)}));
  const shades = colors(points, scene.heights.map(z => z - middle[2]), scene.flat);
  const context = canvas.getContext("2d"), NEAR = 0.02;
  let image = null, pixels = null, depths = null, view = null, waiting = false;

  const [from, to] = scene.view, bulk = from.map((v, i) => (to[i] - v) / 2);
  const top = () => {
    const [x, y, z] = from.map((v, i) => (v + to[i]) / 2 - middle[i]);
    return {x, y, z, turn: 0, tilt: Math.PI / 2, away: 0};
  };
  const reset = () => { view = {...top(), tilt: scene.flat ? Math.PI / 2 : 0.8}; ask(); };

  function ask() {
    if (!waiting) { waiting = true; requestAnimationFrame(draw); }
  }

  function resize() {
    const scale = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (image && canvas.width === width && canvas.height === height) return;
    canvas.width = width; canvas.height = height;
    image = context.createImageData(width, height);
    pixels = new Uint32Array(image.data.buffer);
    depths = new Float32Array(width * height);
  }

  function camera() {  // focal length in pixels, cosines and sines of the angles; sets view.away if it is 0
    const focal = 1.2 * Math.min(canvas.width, canvas.height);
    if (!view.away) {
      const tall = bulk[1] * Math.sin(view.tilt) + bulk[2] * Math.cos(view.tilt);
      view.away = Math.max(2 * bulk[0] / canvas.width, 2 * tall / canvas.height) * focal
        + bulk[1] * Math.cos(view.tilt) + bulk[2] * Math.sin(view.tilt) + 0.5;
    }
    return {focal, c: Math.cos(view.turn), s: Math.sin(view.turn), ct: Math.cos(view.tilt), st: Math.sin(view.tilt)};
  }

  function draw() {
    waiting = false;
    resize();
    const {focal, c, s, ct, st} = camera(), width = canvas.width, height = canvas.height;
    const near = NEAR * view.away, grain = focal * scene.grain, cx = width / 2, cy = height / 2;
    pixels.fill(0); depths.fill(Infinity);
    for (let i = 0; i < count; i++) {
      const x = points[3 * i] - view.x, y = points[3 * i + 1] - view.y, z = points[3 * i + 2] - view.z;
      const deep = s * x + c * y, w = deep * ct - z * st + view.away;
      if (w < near) continue;
      const size = Math.min(6, Math.max(1, Math.round(grain / w)));
      const u = Math.round(cx + focal * (c * x - s * y) / w - size / 2);
      const v = Math.round(cy - focal * (deep * st + z * ct) / w - size / 2);
      if (u < 0 || v < 0 || u + size > width || v + size > height) continue;
      for (let b = v; b < v + size; b++) for (let a = b * width + u; a < b * width + u + size; a++)
        if (w < depths[a]) { depths[a] = w; pixels[a] = shades[i]; }
    }
    context.putImageData(image, 0, 0);
    const scale = width / canvas.clientWidth;
    for (const line of lines) stroke(line, scale, near, focal, c, s, ct, st, cx, cy);
    if (scene.flat) ruler(scale, view.away / focal);
    canvas.dataset.drawn = count;
  }

  function ruler(scale, meter) {  // scale bar of a round length at the lower left; meter: meters per pixel
    const most = 0.2 * canvas.width * meter, decade = 10 ** Math.floor(Math.log10(most));
    const length = decade * (most >= 5 * decade ? 5 : most >= 2 * decade ? 2 : 1), x = 12 * scale, y = canvas.height - x;
    context.setLineDash([]); context.lineWidth = 2 * scale; context.strokeStyle = context.fillStyle = "#e7eaee";
    context.font = `${12 * scale}px system-ui, sans-serif`;
    context.beginPath(); context.moveTo(x, y); context.lineTo(x + length / meter, y); context.stroke();
    context.fillText(`${+length.toPrecision(1)} m`, x, y - 6 * scale);
  }

  function stroke(line, scale, near, focal, c, s, ct, st, cx, cy) {
    context.strokeStyle = line.color; context.lineWidth = line.width * scale;
    context.setLineDash(line.dashed ? [4 * scale, 4 * scale] : []);
    context.lineJoin = context.lineCap = "round";
    context.beginPath();
    let open = false;
    for (let i = 0; i < line.points.length; i += 3) {
      const x = line.points[i] - view.x, y = line.points[i + 1] - view.y, z = line.points[i + 2] - view.z;
      const deep = s * x + c * y, w = deep * ct - z * st + view.away;
      if (line.pairs && i % 6 === 0) open = false;
      if (w < near) { open = false; continue; }
      const u = cx + focal * (c * x - s * y) / w, v = cy - focal * (deep * st + z * ct) / w;
      if (open) context.lineTo(u, v); else context.moveTo(u, v);
      open = true;
    }
    context.stroke();
  }

  function turn(du, dv) {
    view.turn += du * 0.008;
    view.tilt = Math.min(Math.PI / 2, Math.max(-0.2, view.tilt + dv * 0.008));
    ask();
  }
  function move(du, dv) {  // along the ground, so that what is under the pointer stays there
    const meter = view.away / (1.2 * Math.min(canvas.clientWidth, canvas.clientHeight));
    const right = -du * meter, up = dv * meter / Math.max(Math.sin(view.tilt), 0.3);
    view.x += Math.cos(view.turn) * right + Math.sin(view.turn) * up;
    view.y += Math.cos(view.turn) * up - Math.sin(view.turn) * right;
    ask();
  }
  function zoom(factor) {
    view.away = Math.min(20 * Math.hypot(...half), Math.max(0.5, view.away * factor));
    ask();
  }

  const fingers = new Map();
  canvas.addEventListener("pointerdown", event => {
    canvas.focus({preventScroll: true});
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], du = now[0] - before[0], dv = now[1] - before[1];
    const other = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at)[0];
    fingers.set(event.pointerId, now);
    if (other) {
      const apart = at => Math.max(1, Math.hypot(at[0] - other[0], at[1] - other[1]));
      zoom(apart(before) / apart(now));
      move(du / 2, dv / 2);
    } else if (event.shiftKey || event.buttons > 1 || scene.flat) move(du, dv);
    else turn(du, dv);
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"])
    canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("wheel", event => {  // the page scrolls unless the map was clicked
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.005));
  }, {passive: false});
  canvas.addEventListener("dblclick", reset);
  const keys = {ArrowLeft: () => turn(-12, 0), ArrowRight: () => turn(12, 0), ArrowUp: () => turn(0, 12),
    ArrowDown: () => turn(0, -12), "+": () => zoom(0.8), "-": () => zoom(1.25), 0: reset};
  canvas.addEventListener("keydown", event => {
    if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
  });
  const buttons = {"+": () => zoom(0.7), "−": () => zoom(1.4), "from above": () => { view = top(); ask(); }, reset};
  if (scene.flat) delete buttons["from above"];
  for (const [name, act] of Object.entries(buttons)) {
    const button = document.createElement("button");
    button.type = "button"; button.textContent = name;
    button.addEventListener("click", act);
    canvas.parentElement.querySelector(".buttons").append(button);
  }
  new ResizeObserver(ask).observe(canvas);
  reset();
}

function colors(points, [bottom, top], flat) {  // by height from dark to bright, paler than the lines
  const anchors = [[62, 66, 100], [72, 96, 118], [104, 132, 126], [168, 164, 122], [240, 214, 140]];
  return Uint32Array.from({length: points.length / 3}, (_, i) => {
    const t = 4 * Math.min(0.9999, Math.max(0, (points[3 * i + 2] - bottom) / Math.max(top - bottom, 1e-6)));
    const k = Math.floor(t), mix = n => Math.round(anchors[k][n] + (t - k) * (anchors[k + 1][n] - anchors[k][n]));
    const [r, g, b] = flat ? [190, 196, 205] : [mix(0), mix(1), mix(2)];
    return (255 << 24 | b << 16 | g << 8 | r) >>> 0;
  });
}
