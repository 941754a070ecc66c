// SPDX-FileCopyrightText: 2026 surfel_mapper contributors
// SPDX-License-Identifier: Apache-2.0
//
// The 3D view of report.html: surfels as discs, drawn in one call, and the trajectory.
//
// A surfel is 12 bytes: place in the box of the map (3 uint16), radius and time (2 uint8), normal
// (3 int8) and the level of its cell times 8. Its values are columns of codes, of which one at a time becomes the
// paint of the discs. Discs are octagons about circles, with corners pulled in to the cell of the
// surfel: no fragment is discarded, and hidden ones cost next to nothing. Every surfel is copied for
// each of its eight corners, 10 MB for 100,000: drawn as instances, they take 30 times as long
// without a graphics card. The picture is drawn only when something has changed, and
// while it moves with so few surfels, larger ones, that a frame takes no longer than SLOW_MS;
// they come in random order, so the first are as good as any.
// In the place of the surfels the mesh of a TSDF or the models can be shown, where there are any: 16
// bytes a vertex (place, colour, normal), drawn whole, and lit from where the eye is.
// Up is the third row of data.level: z, but in the frame of a camera away from the ground. The view
// turns about a point that panning moves.
'use strict';

(() => {
  const VERTEX = `#version 300 es
    in float corner;
    in vec3 place;
    in vec2 look;
    in vec3 normal;
    in vec3 paint;
    uniform mat4 camera;
    uniform vec3 low, size, eye, grid, light;
    uniform float largest, hide, until, lamp, cell, margin;
    out vec3 colour;
    void main() {
      vec3 centre = low + place * size;
      vec3 n = normalize(normal);
      int code = int(corner + 0.5);
      int a = abs(n.x) >= max(abs(n.y), abs(n.z)) ? 0 : abs(n.y) >= abs(n.z) ? 1 : 2;
      float turn = float(code % 8) * 0.7853981634;
      vec3 away = vec3(0);
      away[(a + 1) % 3] = cos(turn);
      away[(a + 2) % 3] = sin(turn) * sign(n[a]);
      away[a] = -dot(away, n) / n[a];
      away = look.x * largest * normalize(away);
      float side = cell * float(1 << code / 8);
      vec3 first = floor((centre + grid) / side) * side - grid - centre - margin;
      vec3 limit = mix(first, first + side + 2.0 * margin, vec3(greaterThan(away, vec3(0))));
      vec3 shares = abs(limit) / max(abs(away), vec3(1e-9));
      vec3 at = centre + away * min(1.0, min(shares.x, min(shares.y, shares.z)));
      float facing = dot(n, normalize(eye - centre));
      bool gone = look.y > until || facing < -hide;
      gl_Position = gone ? vec4(2, 2, 2, 1) : camera * vec4(at, 1);
      float lit = 0.725 + 0.275 * dot(n, light);
      colour = paint * mix(0.62 + 0.38 * abs(facing), lit, lamp);
    }`;
  const FRAGMENT = `#version 300 es
    precision mediump float;
    in vec3 colour;
    out vec4 pixel;
    void main() { pixel = vec4(colour, 1); }`;
  const MESH_VERTEX = `#version 300 es
    in vec3 place;
    in vec3 paint;
    in vec3 normal;
    uniform mat4 camera;
    uniform vec3 reach, eye;
    out vec3 colour;
    void main() {
      vec3 at = (2.0 * place - 1.0) * reach;
      float facing = dot(normalize(normal + vec3(0, 0, 1e-6)), normalize(eye - at));
      gl_Position = camera * vec4(at, 1);
      colour = paint * (0.45 + 0.55 * abs(facing));
    }`;
  const LINE_VERTEX = `#version 300 es
    in vec3 place;
    uniform mat4 camera;
    void main() { gl_Position = camera * vec4(place, 1); gl_PointSize = 9.0; }`;
  const LINE_FRAGMENT = `#version 300 es
    precision mediump float;
    uniform vec3 ink;
    out vec4 pixel;
    void main() { pixel = vec4(ink, 1); }`;

  const BYTES = 12;
  const SLOW_MS = 40;
  const REST_MS = 200;
  const LEAST = 4000;
  const CORNERS = 8;
  const OUTER = 1 / Math.cos(Math.PI / CORNERS); // of an octagon about a circle of radius 1
  const FREE = 1e9; // margin of discs that no cell limits, m
  const FACING = 0.05; // discs are hidden that face away by more than this
  const RED = [0.86, 0.16, 0.13], GREEN = [0.17, 0.63, 0.17], MARK = [1, 0.55, 0];
  const FAN = [0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 5, 0, 5, 6, 0, 6, 7];
  const canvas = document.getElementById('surfels');
  const data = JSON.parse(document.getElementById('map').textContent);
  const gl = canvas.getContext('webgl2', { antialias: true });
  if (!gl) {
    document.getElementById('picture').hidden = false;
    canvas.hidden = true;
    for (const part of document.querySelectorAll('.tools, .scale, .length')) part.hidden = true;
    return;
  }

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
      throw new Error(gl.getProgramInfoLog(made));
    }
    return made;
  }

  function attribute(made, name, size, type, normalised, stride, offset) {
    const place = gl.getAttribLocation(made, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, type, normalised, stride, offset);
  }

  function buffer(values) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  }

  const discs = program(VERTEX, FRAGMENT);
  const discArrays = gl.createVertexArray();
  gl.bindVertexArray(discArrays);
  const surfels = bytes(data.surfels);
  const count = surfels.length / BYTES;
  const corners = new Uint8Array(CORNERS * surfels.length);
  const triangles = new Uint32Array(FAN.length * count);
  for (let row = 0; row < count; row++) {
    for (let corner = 0; corner < CORNERS; corner++) {
      const from = row * BYTES, to = (CORNERS * row + corner) * BYTES;
      for (let byte = 0; byte < BYTES; byte++) corners[to + byte] = surfels[from + byte];
      corners[to + BYTES - 1] += corner;
    }
    FAN.forEach((corner, place) => {
      triangles[FAN.length * row + place] = CORNERS * row + corner;
    });
  }
  buffer(corners);
  attribute(discs, 'place', 3, gl.UNSIGNED_SHORT, true, BYTES, 0);
  attribute(discs, 'look', 2, gl.UNSIGNED_BYTE, true, BYTES, 6);
  attribute(discs, 'normal', 3, gl.BYTE, true, BYTES, 8);
  attribute(discs, 'corner', 1, gl.UNSIGNED_BYTE, false, BYTES, 11);
  const paints = new Uint8Array(4 * CORNERS * count);
  const paintBuffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, paintBuffer);
  attribute(discs, 'paint', 3, gl.UNSIGNED_BYTE, true, 4, 0);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);

  const line = program(LINE_VERTEX, LINE_FRAGMENT);
  const lineArrays = gl.createVertexArray();
  gl.bindVertexArray(lineArrays);
  const path = new Float32Array(bytes(data.trajectory).buffer);
  buffer(path);
  attribute(line, 'place', 3, gl.FLOAT, false, 0, 0);
  const markArrays = gl.createVertexArray();
  const markBuffer = gl.createBuffer();
  gl.bindVertexArray(markArrays);
  gl.bindBuffer(gl.ARRAY_BUFFER, markBuffer);
  attribute(line, 'place', 3, gl.FLOAT, false, 0, 0);

  const mesh = data.layers.length ? program(MESH_VERTEX, FRAGMENT) : null;
  const layers = data.layers.map((layer) => {
    const arrays = gl.createVertexArray();
    gl.bindVertexArray(arrays);
    buffer(bytes(layer.vertices));
    attribute(mesh, 'place', 3, gl.UNSIGNED_SHORT, true, 16, 0);
    attribute(mesh, 'paint', 3, gl.UNSIGNED_BYTE, true, 16, 8);
    attribute(mesh, 'normal', 3, gl.BYTE, true, 16, 12);
    const wedges = new Uint32Array(bytes(layer.triangles).buffer);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, wedges, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { arrays, reach: layer.reach, count: wedges.length };
  });
  const shown = document.getElementById('shown');
  const layerShown = () => (shown ? layers[shown.selectedIndex - 1] : undefined);
  if (shown) {
    shown.addEventListener('change', () => {
      for (const part of ['colouring', 'hide', 'discs']) {
        document.getElementById(part).closest('label').hidden = Boolean(layerShown());
      }
      document.querySelector('.scale').style.display = layerShown() ? 'none' : '';
      showPicks([]);
    });
  }

  const ramp = bytes(data.ramp);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(
    gl.TEXTURE_2D, 0, gl.RGB, ramp.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, ramp,
  );
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
    gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  }
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, filter, gl.LINEAR);
  }

  // All places are about the middle of the map, so that float32 is precise enough anywhere.
  const half = data.size.map((side) => side / 2);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [
    a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
  ];
  const unit = (a) => a.map((value) => value / Math.hypot(...a));
  const levelled = (a) => data.level.map((row) => dot(row, a));
  const unlevelled = (a) => [0, 1, 2].map((i) => dot(data.level.map((row) => row[i]), a));
  const LIGHT = unlevelled([-0.40, -0.55, 0.73]); // as in viz/discs.py
  // The view begins with the surfels that do not face down, without the farthest of them.
  const words = new DataView(surfels.buffer);
  const normalOf = (row) => unit([0, 1, 2].map((i) => words.getInt8(row * BYTES + 8 + i)));
  const placeOf = (row, axis) => (
    words.getUint16(row * BYTES + 2 * axis, true) / 65535 * data.size[axis] - half[axis]
  );
  const corner = (number) => half.map((side, axis) => (number >> axis & 1 ? side : -side));
  let framed = [0, 1, 2, 3, 4, 5, 6, 7].map((number) => [...levelled(corner(number)), 0]);
  const upper = Array.from({ length: count }, (_, row) => row)
    .filter((row) => dot(data.level[2], normalOf(row)) > -0.2)
    .map((row) => [
      ...levelled([0, 1, 2].map((axis) => placeOf(row, axis))),
      surfels[row * BYTES + 6] / 255 * data.largest,
    ]);
  const box = [0, 1, 2].map((axis) => {
    const sorted = Float64Array.from(upper.length ? upper : framed, (at) => at[axis]).sort();
    return upper.length ? [0.03, 0.97].map((part) => sorted[Math.round(part * (upper.length - 1))])
      : [sorted[0], sorted[7]];
  });
  if (upper.length) { // in random order
    framed = upper.filter((at) => box.every(([low, high], i) => at[i] >= low && at[i] <= high))
      .slice(0, 1000);
  }
  const centre = box.map(([low, high]) => (low + high) / 2), middle = unlevelled(centre);
  const reach = box.map(([low, high]) => (high - low) / 2 + data.largest);
  for (let pose = 0; pose < path.length; pose += 3) {
    const at = levelled(path.subarray(pose, pose + 3));
    const isNear = at.every((value, i) => Math.abs(value - centre[i]) < 1.5 * reach[i]);
    if (isNear) framed.push([...at, 0]);
  }
  const radius = Math.max(Math.hypot(...reach), 0.5);
  const across = reach[0] >= reach[1];
  const start = { yaw: across ? -Math.PI / 2 : 0, pitch: 0.75 };
  const MARGIN = 0.94;
  let view, running = false, moved = false, share = 1, last = 0, rest = 0;

  function reset(direction) {
    let [near, far] = [0.5 * radius, 20 * radius];
    for (let step = 0; step < 20; step++) {
      const distance = 0.5 * (near + far);
      view = { ...start, ...direction, target: [...middle], distance };
      if (isWhole()) far = distance;
      else near = distance;
    }
    view.distance = far;
    redraw();
  }

  // Whether the map is in view, on telephones too.
  function isWhole() {
    const eye = eyeOf();
    const [right, up, back] = axes();
    const wide = MARGIN * Math.tan(0.35) * (canvas.clientWidth || 1) / (canvas.clientHeight || 1);
    return framed.every(([x, y, z, size]) => {
      const from = unlevelled([x, y, z]).map((value, i) => value - eye[i]);
      const ahead = -dot(back, from);
      return ahead > 0 && Math.abs(dot(right, from)) + size <= wide * ahead
        && Math.abs(dot(up, from)) + size <= MARGIN * Math.tan(0.35) * ahead;
    });
  }

  function eyeOf() {
    return axes()[2].map((value, i) => view.target[i] + value * view.distance);
  }

  function axes() {
    const back = unlevelled([
      Math.cos(view.pitch) * Math.cos(view.yaw),
      Math.cos(view.pitch) * Math.sin(view.yaw),
      Math.sin(view.pitch),
    ]);
    const right = unlevelled([-Math.sin(view.yaw), Math.cos(view.yaw), 0]);
    return [right, cross(back, right), back];
  }

  function camera(eye) {
    const [right, up, back] = axes();
    const near = Math.max(view.distance / 500, 0.02);
    const far = view.distance + 4 * Math.hypot(radius, ...half);
    const zoom = 1 / Math.tan(0.35);
    const wide = zoom * canvas.height / canvas.width;
    const depth = (far + near) / (near - far);
    const columns = [0, 1, 2].map((i) => [
      wide * right[i], zoom * up[i], depth * back[i], -back[i],
    ]);
    columns.push([
      -wide * dot(right, eye), -zoom * dot(up, eye),
      -depth * dot(back, eye) + 2 * far * near / (near - far), dot(back, eye),
    ]);
    return new Float32Array(columns.flat());
  }

  function draw(part) {
    const drawn = Math.min(Math.max(Math.ceil(part * count), LEAST), count);
    const scale = window.devicePixelRatio || 1;
    const width = Math.max(Math.round(canvas.clientWidth * scale), 1);
    const height = Math.max(Math.round(canvas.clientHeight * scale), 1);
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const style = getComputedStyle(document.documentElement);
    const shade = [0, 1, 2].map((i) => Number(style.getPropertyValue(`--view-${i}`)));
    gl.viewport(0, 0, width, height);
    gl.clearColor(...shade, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const eye = eyeOf();
    const matrix = camera(eye);
    if (layerShown()) drawMesh(layerShown(), matrix, eye);
    else drawDiscs(drawn, matrix, eye);
    drawWay(matrix);
    drawMarks(matrix);
    showLength();
  }

  const time = document.getElementById('time');
  const until = () => time.value / 255;

  function drawWay(matrix) {
    const poses = path.length / 3;
    if (!poses) return;
    gl.useProgram(line);
    gl.bindVertexArray(lineArrays);
    gl.uniformMatrix4fv(gl.getUniformLocation(line, 'camera'), false, matrix);
    gl.uniform3f(gl.getUniformLocation(line, 'ink'), ...GREEN);
    gl.drawArrays(gl.POINTS, 0, 1);
    gl.uniform3f(gl.getUniformLocation(line, 'ink'), ...RED);
    const last = Math.round(until() * (poses - 1));
    gl.drawArrays(gl.LINE_STRIP, 0, last + 1);
    gl.drawArrays(gl.POINTS, last, 1);
  }

  // Rings about the discs that were picked, and the line between two, over all else.
  function drawMarks(matrix) {
    if (!picks.length) return;
    gl.useProgram(line);
    gl.bindVertexArray(markArrays);
    gl.bindBuffer(gl.ARRAY_BUFFER, markBuffer);
    gl.uniformMatrix4fv(gl.getUniformLocation(line, 'camera'), false, matrix);
    gl.uniform3f(gl.getUniformLocation(line, 'ink'), ...MARK);
    gl.disable(gl.DEPTH_TEST);
    for (const { row } of picks) {
      const around = cornersOf(row), ring = [];
      const grown = Math.max(1, 0.006 * view.distance / Math.hypot(...around[0]));
      for (let step = 0; step <= CORNERS; step++) {
        for (const far of [grown, 1.25 * grown]) {
          ring.push(...around[step % CORNERS].map((value, i) => placeOf(row, i) + far * value));
        }
      }
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(ring), gl.DYNAMIC_DRAW);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, ring.length / 3);
    }
    const ends = picks.flatMap(({ at }) => at);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(ends), gl.DYNAMIC_DRAW);
    gl.drawArrays(gl.POINTS, 0, picks.length);
    gl.drawArrays(gl.LINES, 0, picks.length);
    gl.enable(gl.DEPTH_TEST);
  }

  // A bar of a round length at the distance of the point that the view turns about.
  function showLength() {
    const metresOfPixel = 2 * Math.tan(0.35) * view.distance / (canvas.clientHeight || 1);
    const most = 120 * metresOfPixel;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = power * [5, 2, 1].find((digit) => digit * power <= most);
    document.getElementById('bar').style.width = `${length / metresOfPixel}px`;
    document.getElementById('metres').textContent =
      length < 0.01 ? `${+(length * 1000).toPrecision(1)} mm` : `${+length.toPrecision(1)} m`;
  }

  const hides = () => document.getElementById('hide').checked;
  const growth = () => Number(document.getElementById('discs').value);
  const radiusOf = (row) => surfels[row * BYTES + 6] / 255 * data.largest * growth();

  const margin = () => data.cell * growth();
  const cellOf = (row) => data.cell * 2 ** (surfels[row * BYTES + 11] >> 3);

  // The corners of a disc from its middle, pulled in to its cell, as in the shader.
  function cornersOf(row) {
    const n = normalOf(row), sizes = n.map(Math.abs);
    const a = sizes.indexOf(Math.max(...sizes));
    const cell = cellOf(row);
    const low = data.grid.map((value, i) => {
      const at = placeOf(row, i) + value;
      return Math.floor(at / cell) * cell - at - margin();
    });
    return Array.from({ length: CORNERS }, (_, corner) => {
      const away = [0, 0, 0], turn = 2 * Math.PI * corner / CORNERS;
      away[(a + 1) % 3] = Math.cos(turn);
      away[(a + 2) % 3] = Math.sin(turn) * Math.sign(n[a]);
      away[a] = -dot(away, n) / n[a];
      const scale = radiusOf(row) * OUTER / Math.hypot(...away);
      const shares = away.map((value, i) => (
        Math.abs(value > 0 ? low[i] + cell + 2 * margin() : low[i])
          / Math.max(Math.abs(scale * value), 1e-9)
      ));
      return away.map((value) => scale * Math.min(1, ...shares) * value);
    });
  }

  // The disc that is drawn at a place of the canvas: the first that the line of sight meets.
  function pick(x, y) {
    const eye = eyeOf();
    const [right, up, back] = axes();
    const px = 2 * Math.tan(0.35) / canvas.clientHeight;
    const [dx, dy] = [(x - canvas.clientWidth / 2) * px, (canvas.clientHeight / 2 - y) * px];
    const ray = [0, 1, 2].map((i) => dx * right[i] + dy * up[i] - back[i]);
    let nearest = Infinity, picked = null;
    for (let row = 0; row < count; row++) {
      if (surfels[row * BYTES + 7] / 255 > until()) continue;
      const from = [0, 1, 2].map((i) => placeOf(row, i) - eye[i]);
      const beside = Math.hypot(...cross(from, ray)) / Math.hypot(...ray);
      const size = radiusOf(row) * OUTER;
      if (beside > size) continue;
      const n = normalOf(row);
      if (hides() && -dot(n, unit(from)) < -FACING) continue;
      const ahead = dot(n, from) / dot(n, ray);
      if (!(ahead > 0 && ahead < nearest)) continue;
      const at = from.map((value, i) => ahead * ray[i] - value);
      const minus = (point, corner) => point.map((value, i) => value - corner[i]);
      const isOutside = cornersOf(row).some((corner, k, all) => (
        dot(n, cross(minus(all[(k + 1) % CORNERS], corner), minus(at, corner))) < 0
      ));
      if (isOutside) continue;
      nearest = ahead;
      picked = { row, at: eye.map((value, i) => value + ahead * ray[i]) };
    }
    return picked;
  }

  let picks = [];
  const measure = document.getElementById('measure');
  const measures = () => measure.getAttribute('aria-pressed') === 'true';

  function showPicks(shownPicks) {
    picks = shownPicks;
    const values = document.getElementById('values');
    values.hidden = !picks.length;
    if (picks.length > 1) values.textContent = measured(...picks);
    else if (picks.length) values.textContent = valuesOf(picks[0].row);
    redraw();
  }

  function clicked(x, y) {
    const picked = pick(x, y);
    if (!picked) showPicks([]);
    else showPicks(measures() && picks.length === 1 ? [picks[0], picked] : [picked]);
  }

  function measured(first, second) {
    const away = levelled(second.at.map((value, i) => value - first.at[i]));
    const cos = Math.min(Math.abs(dot(normalOf(first.row), normalOf(second.row))), 1);
    return `distance ${Math.hypot(...away).toFixed(3)} m\n`
      + `horizontal ${Math.hypot(away[0], away[1]).toFixed(3)} m\n`
      + `height ${away[2].toFixed(3)} m\n`
      + `between the normals ${(Math.acos(cos) * 180 / Math.PI).toFixed(1)}\u00b0`;
  }

  const columns = data.columns.map((column) => {
    const codes = bytes(column.codes);
    const steps = column.bytes === 2 ? 65535 : 255;
    return { ...column, steps, codes: column.bytes === 2 ? new Uint16Array(codes.buffer) : codes };
  });

  function valueOf(column, row) {
    if (column.name === 'size' && data.cell < FREE) return cellOf(row); // exactly
    if (!column.codes[row]) return NaN;
    const part = (column.codes[row] - 1) / (column.steps - 1);
    const value = column.log ? column.low * (column.high / column.low) ** part
      : column.low + part * (column.high - column.low);
    return column.whole ? Math.round(value) : value;
  }

  // No more digits than the step of the codes, which is a share of the value if they are log.
  function worded(column, value) {
    const step = (column.high - column.low) / column.steps;
    const digits = Math.min(Math.max(Math.ceil(-Math.log10(step)), 0), 9);
    const text = column.log || !step ? value.toPrecision(2) : value.toFixed(digits);
    return `${column.whole || column.name === 'size' ? value : +text}`
      + `${column.unit ? ` ${column.unit}` : ''}`;
  }
  const slopeOf = (row) => (
    Math.acos(Math.min(Math.abs(dot(data.level[2], normalOf(row))), 1)) * 180 / Math.PI
  );

  function valuesOf(row) {
    const place = [0, 1, 2].map((i) => (placeOf(row, i) + data.middle[i]).toFixed(2));
    const normal = normalOf(row).map((value) => value.toFixed(2));
    return [
      `x y z ${place.join(' ')} m`, `normal ${normal.join(' ')}`,
      `slope ${slopeOf(row).toFixed(1)}\u00b0`,
      ...columns.map((column) => `${column.name} ${worded(column, valueOf(column, row))}`),
    ].join('\n');
  }

  // What discs can be coloured by: a paint (red, green, blue) or a value of a scale, of each row.
  const ground = dot(data.level[2], data.middle);
  const colourings = [
    {
      name: 'normal', legend: 'normal: red x, green y, blue z',
      paint: (row) => normalOf(row).map((value) => 255 * (0.484 + 0.45 * (0.5 + 0.5 * value))),
    },
    {
      name: 'height', unit: 'm', shown: box[2].map((value) => value + ground),
      value: (row) => levelled([0, 1, 2].map((i) => placeOf(row, i)))[2] + ground,
    },
    { name: 'slope', unit: '\u00b0', shown: [0, 90], value: slopeOf },
    ...columns.map((column) => ({ ...column, value: (row) => valueOf(column, row) })),
  ];
  const channels = ['red', 'green', 'blue'].map(
    (name) => columns.find((column) => column.name === name),
  );
  if (channels.every(Boolean)) {
    colourings.push({ name: 'colour', paint: (row) => channels.map((one) => valueOf(one, row)) });
  }
  const colouring = document.getElementById('colouring');
  colouring.append(...colourings.map(({ name }) => new Option(name)));

  function paintOf({ paint, value, log, shown: [least, most] = [] }, row) {
    if (paint) return paint(row);
    const one = value(row);
    if (Number.isNaN(one)) return [153, 153, 153];
    const part = log ? Math.log(one / least) / Math.log(most / least)
      : (one - least) / (most - least || 1);
    const entry = Math.round(255 * Math.min(Math.max(part, 0), 1));
    return ramp.subarray(3 * entry, 3 * entry + 3);
  }

  function drawMesh(layer, matrix, eye) {
    gl.useProgram(mesh);
    gl.bindVertexArray(layer.arrays);
    gl.uniformMatrix4fv(gl.getUniformLocation(mesh, 'camera'), false, matrix);
    gl.uniform3f(gl.getUniformLocation(mesh, 'reach'), ...layer.reach);
    gl.uniform3f(gl.getUniformLocation(mesh, 'eye'), ...eye);
    gl.drawElements(gl.TRIANGLES, layer.count, gl.UNSIGNED_INT, 0);
  }

  function drawDiscs(drawn, matrix, eye) {
    gl.useProgram(discs);
    gl.bindVertexArray(discArrays);
    const at = (name) => gl.getUniformLocation(discs, name);
    gl.uniformMatrix4fv(at('camera'), false, matrix);
    gl.uniform3f(at('low'), -half[0], -half[1], -half[2]);
    gl.uniform3f(at('size'), ...data.size);
    gl.uniform3f(at('eye'), ...eye);
    gl.uniform3f(at('light'), ...LIGHT);
    gl.uniform3f(at('grid'), ...data.grid);
    gl.uniform1f(at('cell'), data.cell);
    gl.uniform1f(at('margin'), drawn < count ? FREE : margin());
    const larger = OUTER * growth() * Math.min(Math.sqrt(count / drawn), 2.5);
    gl.uniform1f(at('largest'), data.largest * larger);
    gl.uniform1f(at('hide'), hides() ? FACING : 2);
    gl.uniform1f(at('until'), until() + 1e-4);
    gl.uniform1f(at('lamp'), colouring.selectedIndex ? 0 : 1);
    gl.drawElements(gl.TRIANGLES, FAN.length * drawn, gl.UNSIGNED_INT, 0);
  }

  function redraw() {
    if (!running) requestAnimationFrame(() => draw(1));
  }

  // Frames while the view moves: fewer surfels if the last one took long, all when it rests.
  function frame(now) {
    const cost = now - last;
    last = now;
    if (cost > SLOW_MS) share = Math.max(share * Math.max(SLOW_MS / cost, 0.1), LEAST / count);
    else if (cost < SLOW_MS / 2) share = Math.min(share * 1.1, 1);
    if (moved) {
      moved = false;
      rest = now + REST_MS;
      draw(share);
    }
    running = now < rest;
    if (running) requestAnimationFrame(frame);
    else draw(1);
  }

  function move() {
    moved = true;
    if (running) return;
    running = true;
    requestAnimationFrame((now) => {
      last = now - SLOW_MS / 2;
      frame(now);
    });
  }

  function pan(dx, dy) {
    const [right, up] = axes();
    const step = 2 * Math.tan(0.35) * view.distance / canvas.clientHeight;
    for (let i = 0; i < 3; i++) view.target[i] += step * (dy * up[i] - dx * right[i]);
  }

  function rotate(dx, dy) {
    view.yaw -= dx * 0.006;
    view.pitch = Math.min(Math.max(view.pitch + dy * 0.006, -1.55), 1.55);
  }

  function zoom(factor) {
    view.distance = Math.min(Math.max(view.distance * factor, 0.3), 20 * radius);
  }

  // One pointer turns, or pans with a key or another button; two pan and zoom.
  const pointers = new Map();
  let pressed = null;
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    pressed = [event.clientX, event.clientY];
  });
  canvas.addEventListener('click', (event) => {
    const away = pressed ? Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) : 0;
    if (away > 4 || layerShown()) return; // the end of a drag
    const edge = canvas.getBoundingClientRect();
    clicked(event.clientX - edge.left, event.clientY - edge.top);
  });
  const KEYS = {
    ArrowLeft: [-30, 0], ArrowRight: [30, 0], ArrowUp: [0, -30], ArrowDown: [0, 30],
  };
  const full = document.getElementById('full');
  function fullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.getElementById('view').requestFullscreen();
  }
  full.hidden = !document.fullscreenEnabled;
  full.addEventListener('click', fullScreen);
  canvas.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = KEYS[event.key];
    if (step) (event.shiftKey ? pan : rotate)(...step);
    else if (event.key === '+' || event.key === '=') zoom(0.8);
    else if (event.key === '-') zoom(1.25);
    else if (event.key === '0') reset();
    else if (event.key === 'f' && document.fullscreenEnabled) fullScreen();
    else if (event.key === 'Enter') {
      clicked(canvas.clientWidth / 2, canvas.clientHeight / 2);
    } else return;
    event.preventDefault();
    move();
  });
  for (const end of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener('pointermove', (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    if (pointers.size > 1) {
      const [, other] = [...pointers].find(([id]) => id !== event.pointerId);
      const gap = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
      zoom(gap(before) / gap(now));
      pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.ctrlKey || event.buttons !== 1) {
      pan(dx, dy);
    } else {
      rotate(dx, dy);
    }
    pointers.set(event.pointerId, now);
    move();
  });
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-50, Math.min(event.deltaY, 50)) * 0.004));
    move();
  }, { passive: false });

  const stops = [0, 32, 64, 96, 128, 160, 192, 224, 255].map(
    (entry) => `rgb(${ramp.slice(3 * entry, 3 * entry + 3).join()})`,
  );
  document.querySelector('.scale .ramp').style.background =
    `linear-gradient(to right, ${stops.join()})`;
  function recolour() {
    const chosen = colourings[colouring.selectedIndex];
    for (let row = 0; row < count; row++) {
      const paint = paintOf(chosen, row);
      for (let corner = 0; corner < CORNERS; corner++) {
        paints.set(paint, 4 * (CORNERS * row + corner));
      }
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, paintBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, paints, gl.DYNAMIC_DRAW);
    const unitText = chosen.unit ? ` (${chosen.unit})` : '';
    document.getElementById('unit').textContent = chosen.legend || chosen.name + unitText;
    document.querySelector('.scale .ramp').hidden = !chosen.shown;
    [document.getElementById('least').textContent, document.getElementById('most').textContent] =
      (chosen.shown || ['', '']).map((value) => value && `${+value.toPrecision(3)}`);
    redraw();
  }

  function showTime() {
    const at = data.seconds[Math.round(until() * (data.seconds.length - 1))];
    document.getElementById('seconds').textContent = at === undefined ? '' : `${at.toFixed(1)} s`;
    if (picks.some(({ row }) => surfels[row * BYTES + 7] / 255 > until())) showPicks([]);
    redraw();
  }
  for (const id of ['drive', 'later']) document.getElementById(id).hidden = path.length < 6;
  time.addEventListener('input', showTime);
  measure.addEventListener('click', () => {
    measure.setAttribute('aria-pressed', String(!measures()));
    showPicks([]);
  });
  for (const button of document.querySelectorAll('[data-yaw]')) {
    button.addEventListener('click', () => {
      const [yaw, pitch] = ['yaw', 'pitch'].map((name) => button.dataset[name] * Math.PI / 180);
      reset({ yaw, pitch });
    });
  }
  colouring.addEventListener('change', recolour);
  document.getElementById('hide').addEventListener('change', redraw);
  document.getElementById('discs').addEventListener('input', redraw);
  document.getElementById('reset').addEventListener('click', () => reset());
  new ResizeObserver(redraw).observe(canvas);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', redraw);
  reset();
  recolour();
  showTime();
})();
