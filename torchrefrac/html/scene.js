"use strict";
(() => {
  const find = id => document.getElementById(id);
  const about = JSON.parse(find("about").textContent);
  const bytes = id => Uint8Array.from(atob(find(id).textContent), letter => letter.charCodeAt(0));
  const positions = new Uint16Array(bytes("positions").buffer);
  const photograph = bytes("colors"), sigma = bytes("sigma"), map = bytes("map");
  const pyramids = new Float32Array(bytes("pyramids").buffer), sides = new Float32Array(about.surfaces.flat(2));
  const count = positions.length / 3;
  const canvas = find("view"), gl = canvas.getContext("webgl", {alpha: false});
  if (!gl) {
    find("missing").hidden = false;
    return;
  }

  // What is drawn, anew whenever the browser has taken the graphics processor away.
  const POINTS = `attribute vec3 position, color; uniform mat4 clip; uniform vec3 origin, extent;
    uniform float diameter, least; varying vec3 shade;
    void main() {
      gl_Position = clip * vec4(origin + extent * position, 1.0);
      gl_PointSize = clamp(diameter / gl_Position.w, least, 40.0);
      shade = color;
    }`;
  const ROUND = `precision mediump float; varying vec3 shade;
    void main() {
      if (length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = vec4(shade, 1.0);
    }`;
  const PLACED = "attribute vec3 position; uniform mat4 clip; void main() { gl_Position = clip * vec4(position, 1.0); }";
  const PLAIN = "precision mediump float; uniform vec4 paint; void main() { gl_FragColor = paint; }";
  let points, lines, buffers;

  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.bindAttribLocation(made, 0, "position");
    gl.linkProgram(made);
    return {made, at: name => gl.getUniformLocation(made, name)};
  }

  function stored(values, kind = gl.ARRAY_BUFFER) {
    const buffer = gl.createBuffer();
    gl.bindBuffer(kind, buffer);
    gl.bufferData(kind, values, gl.STATIC_DRAW);
    return buffer;
  }

  function prepare() {
    points = program(POINTS, ROUND);
    lines = program(PLACED, PLAIN);
    const edges = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
    const pairs = new Float32Array(pyramids.length / 15 * edges.length * 3);
    for (let i = 0; i < pairs.length / 3; i++) {
      const corner = 5 * Math.floor(i / edges.length) + edges[i % edges.length];
      pairs.set(pyramids.subarray(3 * corner, 3 * corner + 3), 3 * i);
    }
    buffers = {points: stored(positions), colors: stored(photograph), cameras: stored(pairs), surfaces: stored(sides)};
    buffers.corners = pairs.length / 3;
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(0.933, 0.945, 0.957, 1.0);
    paint();
  }

  // Colours, and what they mean.
  function chosen() {
    const name = document.querySelector("input[name=colors]:checked").value;
    return about.scales.find(scale => scale.name === name);
  }

  function color(share, scale) {
    const row = 3 * Math.round(255 * Math.min(Math.max(scale.reversed ? 1 - share : share, 0), 1));
    return map.subarray(row, row + 3);
  }

  function paint() {
    const scale = chosen();
    let colors = photograph;
    if (scale) {
      colors = new Uint8Array(3 * count);
      const along = scale.axis === null ? null : [about.origin[scale.axis], about.extent[scale.axis] / 65535];
      for (let i = 0; i < count; i++) {
        const value = along ? scale.sign * (along[0] + along[1] * positions[3 * i + scale.axis]) + scale.middle
          : sigma[i] / 255 * scale.high;
        colors.set(color((value - scale.low) / (scale.high - scale.low), scale), 3 * i);
      }
      const steps = [0, 1, 2, 3, 4].map(step => step / 4);
      find("quantity").textContent = scale.label;
      find("bar").style.background = `linear-gradient(to right, ${[...Array(17).keys()].map(
        step => `rgb(${color(step / 16, scale).join()})`).join()})`;
      find("ticks").replaceChildren(...steps.map(step => {
        const tick = document.createElement("span");
        tick.textContent = String(Number((scale.low + step * (scale.high - scale.low)).toPrecision(3))).replace("-", "\u2212");
        return tick;
      }));
    }
    find("legend").hidden = !scale;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.colors);
    gl.bufferData(gl.ARRAY_BUFFER, colors, gl.STATIC_DRAW);
    draw();
  }

  // From where it is looked at: round `target`, turned about the vertical, and raised; angles in radians.
  const HALF_FIELD = Math.tan(0.35), FIRST = {turn: -0.55, rise: 0.6};
  const eye = {target: [0, 0, 0], distance: 1, ...FIRST};

  function frame() {
    const [ct, st, cr, sr] = [Math.cos(eye.turn), Math.sin(eye.turn), Math.cos(eye.rise), Math.sin(eye.rise)];
    return {right: [ct, st, 0], up: [-sr * st, sr * ct, cr], back: [cr * st, -cr * ct, sr]};
  }

  function clip() {
    const {right, up, back} = frame(), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const place = eye.target.map((value, k) => value + eye.distance * back[k]);
    const tall = 1 / HALF_FIELD, wide = tall * canvas.height / canvas.width;
    const near = 0.02 * eye.distance, far = eye.distance + Math.hypot(...eye.target) + 3 * about.radius;
    const depth = (far + near) / (far - near), shift = 2 * far * near / (far - near);
    const columns = [0, 1, 2].flatMap(k => [wide * right[k], tall * up[k], -depth * back[k], -back[k]]);
    return [...columns, -wide * dot(right, place), -tall * dot(up, place), depth * dot(back, place) - shift, dot(back, place)];
  }

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      if (!gl.isContextLost()) render();
    });
  }

  function placed(buffer) {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.enableVertexAttribArray(0);
  }

  function render() {
    const seen = clip(), ratio = Math.min(devicePixelRatio || 1, 2);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(points.made);
    gl.uniformMatrix4fv(points.at("clip"), false, seen);
    gl.uniform3fv(points.at("origin"), about.origin);
    gl.uniform3fv(points.at("extent"), about.extent);
    const larger = 2 ** Number(find("size").value);
    gl.uniform1f(points.at("diameter"), larger * 1.5 * about.spacing * canvas.height / (2 * HALF_FIELD));
    gl.uniform1f(points.at("least"), Math.max(larger * about.least, 1) * ratio);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.points);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 6, 0);
    gl.enableVertexAttribArray(0);
    const shade = gl.getAttribLocation(points.made, "color");
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.colors);
    gl.vertexAttribPointer(shade, 3, gl.UNSIGNED_BYTE, true, 3, 0);
    gl.enableVertexAttribArray(shade);
    gl.drawArrays(gl.POINTS, 0, count);
    gl.disableVertexAttribArray(shade);

    gl.useProgram(lines.made);
    gl.uniformMatrix4fv(lines.at("clip"), false, seen);
    if (find("cameras").checked) {
      placed(buffers.cameras);
      gl.uniform4f(lines.at("paint"), 0.13, 0.13, 0.13, 1);
      gl.drawArrays(gl.LINES, 0, buffers.corners);
    }
    if (find("surface")?.checked) {
      placed(buffers.surfaces);
      for (let first = 0; first < sides.length / 3; first += 4) {
        gl.uniform4f(lines.at("paint"), 0.17, 0.48, 0.73, 1);
        gl.drawArrays(gl.LINE_LOOP, first, 4);
        gl.enable(gl.BLEND);
        gl.depthMask(false);
        gl.uniform4f(lines.at("paint"), 0.17, 0.48, 0.73, 0.15);
        gl.drawArrays(gl.TRIANGLE_FAN, first, 4);
        gl.depthMask(true);
        gl.disable(gl.BLEND);
      }
    }
  }

  // What changes the view.
  function turn(across, up) {
    eye.turn -= across;
    eye.rise = Math.min(Math.max(eye.rise + up, -1.5), Math.PI / 2);
    draw();
  }

  function move(across, up) {
    const {right, up: upwards} = frame(), step = 2 * HALF_FIELD * eye.distance / canvas.clientHeight;
    eye.target = eye.target.map((value, k) => value - step * (across * right[k] - up * upwards[k]));
    draw();
  }

  function zoom(factor) {
    eye.distance = Math.min(Math.max(eye.distance * factor, 0.003 * about.radius), 30 * about.radius);
    draw();
  }

  function show(direction) {
    const narrow = Math.min(1, canvas.clientWidth / canvas.clientHeight);
    Object.assign(eye, {target: [0, 0, 0], distance: about.radius / (HALF_FIELD * narrow), ...direction});
    draw();
  }

  const held = new Map();
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
  });
  canvas.addEventListener("pointermove", event => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const across = event.clientX - before.clientX, up = event.clientY - before.clientY;
    const other = [...held.values()].find(one => one.pointerId !== event.pointerId);
    if (other) {
      const gap = one => Math.max(Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY), 1);
      zoom(gap(before) / gap(event));
      move(across / 2, up / 2);
    } else if (event.shiftKey || event.buttons > 1) {
      move(across, up);
    } else {
      turn(0.008 * across, 0.008 * up);
    }
    held.set(event.pointerId, event);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, event => held.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)));
  }, {passive: false});
  canvas.addEventListener("keydown", event => {
    const arrow = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key];
    const other = {"+": () => zoom(0.8), "=": () => zoom(0.8), "-": () => zoom(1.25), "0": () => show(FIRST)}[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || !(arrow || other)) return;
    event.preventDefault();
    if (other) other();
    else if (event.shiftKey) move(40 * arrow[0], 40 * arrow[1]);
    else turn(0.1 * arrow[0], 0.1 * arrow[1]);
  });
  const buttons = {
    all: () => show(FIRST), along: () => show(about.along), side: () => show(about.side),
    nearer: () => zoom(0.8), farther: () => zoom(1.25),
  };
  for (const [name, action] of Object.entries(buttons)) find(name).addEventListener("click", action);
  for (const one of document.querySelectorAll("input[name=colors]")) one.addEventListener("change", paint);
  for (const one of document.querySelectorAll("input[type=checkbox], input[type=range]")) one.addEventListener("input", draw);
  find("controls").addEventListener("submit", event => event.preventDefault());
  canvas.addEventListener("webglcontextlost", event => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", prepare);

  let first = true;
  new ResizeObserver(() => {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(ratio * canvas.clientWidth));
    canvas.height = Math.max(1, Math.round(ratio * canvas.clientHeight));
    if (first) show(FIRST);
    first = false;
    draw();
  }).observe(canvas);
  prepare();
})();
