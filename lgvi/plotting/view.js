// Boxes that turn, side by side, on the canvas of a page. Dragging, or the arrow keys, turn the view.
function showMotions(root) {
  const scene = JSON.parse(root.querySelector("script").textContent);
  const canvas = root.querySelector("canvas"), chooser = root.querySelector("select");
  const slider = root.querySelector("input"), button = root.querySelector("button");
  const output = root.querySelector("output");
  let turn = 0.6, tilt = 0.35, motion, timer = 0, print = false;

  // Rotation matrix of a quaternion, row by row, from principal axes to space.
  function matrix(q) {
    const [w, x, y, z] = q.map(part => part / Math.hypot(...q));
    return [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
  }

  const rotate = (R, x) =>
    [0, 3, 6].map(i => R[i] * x[0] + R[i + 1] * x[1] + R[i + 2] * x[2]);

  // To the right, up, and away from the reader.
  function toView([x, y, z]) {
    const c = Math.cos(turn), s = Math.sin(turn), ct = Math.cos(tilt), st = Math.sin(tilt);
    const right = c * x + s * y, away = -s * x + c * y;
    return [right, ct * z + st * away, ct * away - st * z];
  }

  // Faces of the box, and the ellipses in which principal planes cut the inertia ellipsoid.
  const bodies = scene.bodies.map(({ lengths, ellipsoid }) => {
    const faces = [], ellipses = [];
    for (let axis = 0; axis < 3; axis++) {
      const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
      for (const side of [-1, 1]) {
        const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => {
          const corner = [0, 0, 0];
          corner[axis] = side; corner[u] = a; corner[v] = b;
          return corner.map((value, i) => value * lengths[i] / 2);
        });
        faces.push({ corners, color: scene.colors[axis] });
      }
      if (ellipsoid) ellipses.push(Array.from({ length: 65 }, (_, k) => {
        const point = [0, 0, 0], angle = 2 * Math.PI * k / 64;
        point[u] = ellipsoid[u] * Math.cos(angle); point[v] = ellipsoid[v] * Math.sin(angle);
        return point;
      }));
    }
    const reach = 2 * Math.max(Math.hypot(...lengths) / 2, ...(ellipsoid || []));
    return { faces, ellipses, reach, corner: lengths.map(length => length / 2) };
  });

  function choose(number) {
    motion = scene.motions[number];
    motion.shown.forEach(one => {
      one.matrices ??= one.attitudes.map(matrix);
      one.path ??= one.matrices.map(R => rotate(R, bodies[motion.body].corner));
    });
    if (slider) slider.max = motion.times.length - 1;
  }

  function line(g, points, place) {
    g.beginPath();
    points.forEach((x, i) => i ? g.lineTo(...place(toView(x))) : g.moveTo(...place(toView(x))));
  }

  function drawOne(g, one, k, middle, width, ratio, ink) {
    const body = bodies[motion.body], at = motion.at[k], height = canvas.height;
    const scale = 0.8 * Math.min(width, height) / body.reach;
    const place = v => [middle + scale * v[0], height / 2 - scale * v[1]];
    g.lineWidth = 1.5 * ratio;
    g.strokeStyle = scene.colors[1];
    line(g, one.path.slice(0, at + 1), place);
    g.stroke();
    const seen = body.faces.map(({ corners, color }) => {
      const inSpace = corners.map(x => rotate(one.matrices[at], x));
      return { inSpace, color, depth: inSpace.reduce((sum, x) => sum + toView(x)[2], 0) };
    });
    seen.sort((a, b) => b.depth - a.depth);
    g.lineWidth = ratio;
    g.strokeStyle = ink;
    for (const { inSpace, color } of seen) {
      line(g, inSpace, place);
      g.closePath();
      g.globalAlpha = body.ellipses.length ? 0.6 : 0.85;
      g.fillStyle = color;
      g.fill();
      g.globalAlpha = 1;
      g.stroke();
    }
    for (const ellipse of body.ellipses) {
      line(g, ellipse.map(x => rotate(one.matrices[at], x)), place);
      g.stroke();
    }
    g.fillStyle = ink;
    g.font = `${14 * ratio}px sans-serif`;
    g.textAlign = "center";
    g.fillText(one.label, middle, 18 * ratio);
  }

  // The directions of the frame in which the bodies turn.
  function drawFrame(g, ratio, ink) {
    const place = v => [34 * ratio + v[0], canvas.height - 34 * ratio - v[1]];
    g.strokeStyle = g.fillStyle = ink;
    g.lineWidth = ratio;
    g.font = `${12 * ratio}px sans-serif`;
    g.textAlign = "center";
    for (const [name, end] of Object.entries({ x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] })) {
      line(g, [[0, 0, 0], end.map(x => 20 * ratio * x)], place);
      g.stroke();
      const [x, y] = place(toView(end.map(x => 27 * ratio * x)));
      g.fillText(name, x, y + 4 * ratio);
    }
  }

  function draw() {
    const k = slider ? +slider.value : 0, g = canvas.getContext("2d");
    const ratio = print ? 3 : devicePixelRatio || 1;
    const ink = print ? "#222" : getComputedStyle(canvas).color;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    const width = canvas.width / motion.shown.length;
    motion.shown.forEach((one, i) => drawOne(g, one, k, (i + 0.5) * width, width, ratio, ink));
    drawFrame(g, ratio, ink);
    if (!slider) return;
    output.value = `${motion.times[k].toFixed(scene.digits)} s`;
    if (motion.apart) output.value += `, ${motion.apart[k]}° apart`;
    slider.setAttribute("aria-valuetext", output.value);
  }

  function play(on) {
    cancelAnimationFrame(timer);
    button.textContent = on ? "pause" : "play";
    if (!on) return;
    const began = performance.now(), count = motion.times.length;
    const elapsed = motion.times.map(t => Math.abs(t - motion.times[0]) / scene.speed);
    // The last frame lasts as long as the mean of the others.
    const whole = elapsed[count - 1] * count / (count - 1), from = elapsed[+slider.value];
    timer = requestAnimationFrame(function frame(now) {
      const played = (from + Math.max(0, now - began) / 1000) % whole;
      slider.value = elapsed.findLastIndex(time => time <= played);
      draw();
      timer = requestAnimationFrame(frame);
    });
  }

  canvas.onpointermove = event => {
    if (!event.buttons) return;
    turn -= event.movementX / 150;
    tilt += event.movementY / 150;
    draw();
  };
  canvas.onkeydown = event => {
    const [right, up] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1],
                          ArrowDown: [0, -1] }[event.key] || [0, 0];
    if (!right && !up) return;
    event.preventDefault();
    turn -= 0.1 * right;
    tilt -= 0.1 * up;
    draw();
  };
  choose(chooser ? +chooser.value : 0);
  if (chooser) chooser.onchange = () => { play(false); choose(+chooser.value); draw(); };
  if (slider) {
    slider.value = scene.begin * slider.max;
    slider.oninput = () => { play(false); draw(); };
    button.onclick = () => play(button.textContent === "play");
    play(scene.plays && !matchMedia("(prefers-reduced-motion: reduce)").matches);
  }
  addEventListener("beforeprint", () => { print = true; draw(); });
  addEventListener("afterprint", () => { print = false; draw(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas);
}
