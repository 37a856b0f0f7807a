// Plays the scenes that harness/report/player.py has written into the page. Between two steps a vehicle moves at
// constant acceleration. Moments and positions of the slider are steps of the episode, times are in seconds.
"use strict";
(() => {
  const STEP = 0.1, LENGTH = 5, WIDTH = 1.9, LANE = 3.6, BRAKES = -0.5, NEAR = 1e-6;
  const COLOURS = { LV: "green", BV: "vermillion", SV: "vermillion", POV: "vermillion", AV: "blue", "r157-cc": "reference", "brakes-8": "muted" };
  Object.assign(COLOURS, { A: "blue", B: "reference" });
  const SPEEDS = [0.1, 0.25, 0.5, 1], TICKS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200];
  const COLUMNS = ["vehicle", "speed, m/s", "acceleration, m/s²", "gap to ", "closing, m/s", "time to collision, s"];
  const STAR = "M0-15 3.5-5 12-10 6-1 15 3 5 5 6 14 0 7-6 14-5 5-15 3-6-1-12-10-3.5-5Z";
  const SVG = document.querySelector(".player svg").namespaceURI;

  function set(element, attributes) {
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  }
  function add(parent, tag, attributes = {}, text = "") {
    const space = tag === "svg" ? SVG : parent.namespaceURI, element = document.createElementNS(space, tag);
    set(element, attributes);
    element.textContent = text;
    return parent.appendChild(element);
  }
  const show = (element, shown) => element.classList.toggle("off", !shown);
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
  const minus = (text) => text.replace("-", "−");
  const tenths = (value) => minus((Math.abs(value) < 0.05 ? 0 : value).toFixed(1));

  function play(root) {
    const scenes = JSON.parse(root.querySelector("script").textContent);
    let scene, tracks, main, ahead, others, first, end, t, scale, anchor, width, road, moving, charts, cells, playing, before;

    const pick = add(root, "div", { class: "pick" });
    const title = add(root, "h3");
    const view = root.appendChild(root.querySelector("svg"));
    const bar = add(root, "div", { class: "bar" }), button = add(bar, "button", { class: "go" });
    const slider = add(bar, "input", { type: "range", step: 1, "aria-label": "Time in steps of 0.1 s" });
    const clock = add(bar, "output", { class: "clock" });
    const speed = add(bar, "select", { "aria-label": "Speed of playing" });
    for (const each of SPEEDS) add(speed, "option", { value: each }, `${each} ×`);
    speed.value = 0.25;
    const [jumps, curves, scroll] = ["jumps", "curves", "scroll"].map((name) => add(root, "div", { class: name }));
    const table = add(scroll, "table", { class: "now" });
    scroll.tabIndex = 0;
    const facts = add(root, "dl", { class: "told" });

    // -- what a scene holds --
    const called = (track) => track.label ?? track.name;
    const colour = (track) => `--own: var(--${COLOURS[called(track)]})`;
    const dashed = (track) => (others.includes(track) ? " dashed" : "");
    const last = (track) => (scene.first + track.x.length - 1) * STEP;
    const there = (track) => t <= last(track) + NEAR;
    const apart = (track) => !others.includes(track) || t > scene.apart * STEP - NEAR;
    const gap = (track, time) => at(main, time).x - LENGTH - at(track, time).x;
    function at(track, time) {
      const most = track.x.length - 1, place = clamp(time / STEP - scene.first, 0, most);
      const i = Math.min(Math.floor(place + NEAR), Math.max(most - 1, 0)), part = place - i;
      const v = track.v[i], change = (track.v[i + 1] ?? v) - v;
      return { x: track.x[i] + (v + (change * part) / 2) * part * STEP, v: v + change * part, a: change / STEP };
    }
    function sideways({ over = [1] }) {
      const place = clamp(t / STEP - scene.first, 0, over.length - 1), i = Math.floor(place + NEAR);
      return over[i] + (place - i) * ((over[i + 1] ?? over[i]) - over[i]);
    }
    const moved = (track, from, to) => at(track, to).x - at(track, from).x;
    const camera = (time) => at(tracks.AV, time).x + Math.max(moved(main, last(tracks.AV), time), 0);

    function load(index) {
      run(false);
      scene = scenes[index];
      tracks = Object.fromEntries(scene.tracks.map((track) => [track.name, track]));
      main = tracks[scene.principal];
      ahead = scene.tracks.filter((track) => track !== main && track !== tracks.AV);
      others = scene.ghosts;
      first = scene.first * STEP;
      end = Math.max(first + STEP, ...[...scene.tracks, ...others].map(last));
      pick.querySelectorAll("button").forEach((each, i) => set(each, { "aria-pressed": i === index }));
      title.textContent = scene.title;
      set(slider, { min: scene.first, max: Math.round(end / STEP) });
      jumps.replaceChildren();
      const stops = [[scene.first, "start"], ...scene.moments, [Math.round(end / STEP), "end"]];
      for (const [step, name] of stops) add(jumps, "button", {}, name).onclick = () => go(step * STEP, true);
      for (const each of [facts, table]) each.replaceChildren();
      for (const fact of scene.facts) fact.forEach((text, i) => add(facts, i ? "dd" : "dt", {}, text));
      const head = add(add(table, "thead"), "tr"), body = add(table, "tbody");
      for (const each of COLUMNS) {
        add(head, "th", { scope: "col" }, each === "gap to " ? `${each}${main.name}, m` : each);
      }
      cells = [tracks.AV, ...others, main, ...ahead].map((track) => {
        const row = add(body, "tr");
        add(row, "th", { scope: "row", class: `key${dashed(track)}`, style: colour(track) }, called(track));
        return [track, COLUMNS.slice(1).map(() => add(row, "td"))];
      });
      t = Math.max(first, ((scene.event ?? 0) - 5) * STEP);
      layout();
    }

    // -- drawing: once for a scene and a width, then for each moment --
    function layout() {
      width = view.clientWidth || 320;
      let front = 5, behind = 2;
      for (let time = Math.max(first, (scene.onset - 8) * STEP); time <= end; time += STEP) {
        if (time <= last(tracks.AV)) front = Math.max(front, gap(tracks.AV, time));
        for (const each of others) if (time <= last(each)) behind = Math.max(behind, camera(time) - at(each, time).x);
      }
      scale = width / clamp(front + behind + 2 * LENGTH + 8, 40, clamp(width / 4.6, 40, 100));
      anchor = Math.min((behind + LENGTH + 3) * scale, width * (width < 640 ? 0.36 : 0.5));
      const [lane, w, l] = [LANE, WIDTH, LENGTH].map((each) => each * scale);
      const top = 18, low = top + 2 * lane, height = low + 22 + 14 * Math.max(others.length, 1);
      view.replaceChildren();
      set(view, { viewBox: `0 0 ${width} ${height}`, height });
      add(view, "rect", { class: "asphalt", y: top, width, height: 2 * lane });
      add(view, "path", { class: "edge", d: `M0 ${top}h${width}m0 ${2 * lane}h${-width}` });
      const middle = add(view, "path", { class: "middle", d: `M0 ${top + lane}h${width}` });
      const ruler = add(view, "path", { class: "ruler", d: `M0 ${low + 4}h${width}` });
      set(middle, { "stroke-dasharray": `${4 * scale} ${8 * scale}` });
      set(ruler, { "stroke-dasharray": `1.5 ${10 * scale - 1.5}` });
      add(view, "text", { class: "tick", x: width - 4, y: height - 4, "text-anchor": "end" }, "ticks: 10 m");
      moving = [...others, ...ahead, tracks.AV, main].map((track) => {
        const ghost = others.indexOf(track);
        const group = add(view, "g", { class: `car${dashed(track)}`, style: colour(track) });
        add(group, "rect", { class: "body", x: -l, y: -w / 2, width: l, height: w, rx: w * 0.28 });
        add(group, "rect", { class: "glass", x: -0.3 * l, y: -0.4 * w, width: 0.08 * l, height: 0.8 * w, rx: 2 });
        add(group, "text", { x: -0.6 * l, "font-size": clamp(0.62 * w, 8, 13) }, called(track));
        const lights = add(group, "rect", { class: "lights", x: -l - 1, y: -0.42 * w, width: 4, height: 0.84 * w });
        return { track, ghost, group, lights, label: add(view, "text", { class: "label", style: colour(track) }) };
      });
      road = { lane, top, low, middle, ruler, star: add(view, "path", { class: "star", d: STAR }) };
      curves.replaceChildren();
      charts = [
        chart(`gap to ${main.name}, m`, [...others, tracks.AV], gap, 0),
        chart("speed, m/s", [...ahead, main, ...others, tracks.AV], (track, time) => at(track, time).v),
      ];
      draw();
    }

    function chart(name, lines, value, least = null) {
      const w = curves.clientWidth > 700 ? curves.clientWidth / 2 - 12 : curves.clientWidth || 320;
      const left = 34, right = w - 8;
      const X = (time) => left + ((time - first) / (end - first)) * (right - left), rows = [];
      const moments = [...scene.moments].reverse().map(([moment, what]) => {  // each name in the lowest row with room
        const x = X(moment * STEP), from = clamp(x - 3, left, right - 6 * what.length);
        const row = [...rows, w].findIndex((taken) => from + 6 * what.length < taken);
        rows[row] = from;
        return { x, from, row, what };
      });
      const top = 21 + 11 * rows.length, bottom = top + 128, h = bottom + 22;
      const box = add(curves, "svg", { viewBox: `0 0 ${w} ${h}`, height: h, role: "img", "aria-label": name });
      const points = (track) => track.x.map((_, i) => [first + i * STEP, value(track, first + i * STEP)]);
      const values = lines.flatMap(points).map((point) => point[1]), high = Math.max(...values) + 0.5;
      const low = least ?? Math.min(...values) - 0.5;
      const Y = (v) => bottom - ((v - low) / (high - low)) * (bottom - top);
      const [step, seconds] = [(high - low) / 5, ((end - first) * 55) / w].map((n) => TICKS.find((each) => each >= n));
      add(box, "text", { class: "head", x: left, y: 12 }, name);
      for (let v = Math.ceil(low / step) * step; v <= high; v += step) {
        add(box, "line", { class: "grid", x1: left, x2: right, y1: Y(v), y2: Y(v) });
        add(box, "text", { class: "tick", x: left - 6, y: Y(v) + 4, "text-anchor": "end" }, minus(`${+v.toFixed(1)}`));
      }
      for (let s = Math.ceil(first / seconds - NEAR) * seconds; s <= end + NEAR; s += seconds) {
        const unit = s + seconds > end + NEAR ? " s" : "", place = X(s) > right - 12 ? "end" : "middle";
        add(box, "text", { class: "tick", x: X(s), y: h - 6, "text-anchor": place }, +s.toFixed(1) + unit);
      }
      for (const { x, from, row, what } of moments) {
        add(box, "line", { class: "moment", x1: x, x2: x, y1: top - 2 - 11 * row, y2: bottom });
        add(box, "text", { class: "tick", x: from, y: top - 6 - 11 * row }, what);
      }
      const dots = lines.map((track) => {
        const d = points(track).map(([time, v], i) => `${i ? "L" : "M"}${X(time).toFixed(1)} ${Y(v).toFixed(1)}`);
        add(box, "path", { class: `curve${dashed(track)}`, style: colour(track), d: d.join("") });
        const cross = `M${X(track.crash * STEP) - 4} ${Y(value(track, track.crash * STEP)) - 4}l8 8m0-8l-8 8`;
        if (track.crash !== null) add(box, "path", { class: "cross", d: cross });
        return [track, add(box, "circle", { class: "dot", r: 3.5, style: colour(track) })];
      });
      const cursor = add(box, "line", { class: "cursor", y1: top - 2, y2: bottom });
      box.onpointerdown = box.onpointermove = (event) => {
        if (!event.buttons) return;
        const place = box.getBoundingClientRect(), x = ((event.clientX - place.left) * w) / place.width;
        go(first + ((x - left) / (right - left)) * (end - first), true);
      };
      return () => {
        set(cursor, { x1: X(t), x2: X(t) });
        for (const [track, dot] of dots) {
          show(dot, there(track) && apart(track));
          set(dot, { cx: X(t), cy: Y(value(track, t)) });
        }
      };
    }

    function draw() {
      const { lane, top, low, middle, ruler, star } = road, eye = camera(t) - anchor / scale;
      set(middle, { "stroke-dashoffset": (eye % 12) * scale });
      set(ruler, { "stroke-dashoffset": (eye % 10) * scale });
      let ends = width - 6;  // of names above the road, where no vehicle is
      for (const { track, ghost, group, lights, label } of moving) {
        const now = at(track, t), x = (now.x - eye) * scale, rear = x - LENGTH * scale;
        const y = top + lane * (0.5 + sideways(track));
        const gone = !there(track), crashed = gone && track.crash !== null, seen = apart(track) && (crashed || !gone);
        show(group, seen);
        group.classList.toggle("faded", crashed || (track === main && !there(tracks.AV)));
        set(group, { transform: `translate(${x.toFixed(2)} ${y.toFixed(2)})` });
        show(lights, !gone && now.a <= BRAKES);
        const beyond = rear > width - 0.4 * LENGTH * scale - 10, far = Math.round(now.x - at(tracks.AV, t).x - LENGTH);
        show(label, seen && (ghost >= 0 || beyond));
        const name = `${x < 8 ? "◂ " : ""}${called(track)}${crashed ? " crashed" : ""}`;
        label.textContent = beyond ? `${name} ${far} m ▸` : name;
        const room = 8 * label.textContent.length, edge = ghost < 0 ? ends : width - 6;
        const from = beyond ? edge : clamp(rear, 4, Math.max(width - room, 4));
        if (beyond && ghost < 0 && seen) ends -= room + 10;
        set(label, { x: from, y: ghost < 0 ? top - 5 : low + 18 + 14 * ghost, "text-anchor": beyond ? "end" : "start" });
      }
      const hit = `${(at(tracks.AV, t).x - eye) * scale} ${top + 1.5 * lane}`;
      show(star, tracks.AV.crash !== null && t >= tracks.AV.crash * STEP - NEAR);
      set(star, { transform: `translate(${hit}) scale(${clamp(scale / 18, 0.4, 1.3)})` });
      clock.textContent = `${t.toFixed(2)} s`;
      slider.value = Math.round(t / STEP);
      for (const [track, boxes] of cells) {
        const now = at(track, t), closing = now.v - at(main, t).v, room = gap(track, t), on = there(track);
        const texts = on ? [tenths(now.v), tenths(now.a)] : [];
        if (on && (track === tracks.AV || others.includes(track))) texts.push(tenths(room), tenths(closing));
        if (texts.length > 2 && closing > 0.05 && room > 0) texts.push(tenths(room / closing));
        boxes.forEach((box, i) => { box.textContent = texts[i] ?? "–"; });
      }
      for (const each of charts) each();
    }

    // -- time --
    function go(time, stops = false) {
      if (stops) run(false);
      t = clamp(time, first, end);
      draw();
    }
    function run(on) {
      playing = on;
      button.textContent = on ? "❚❚ Pause" : "▶ Play";
      if (on && t >= end - NEAR) go(first);
      before = performance.now();
      if (on) requestAnimationFrame(tick);
    }
    function tick(now) {
      if (!playing) return;
      const then = t + (Math.max(now - before, 0) / 1000) * speed.value;
      before = now;
      go(then, then >= end);
      requestAnimationFrame(tick);
    }
    const step = (n) => go((Math.round(t / STEP) + n) * STEP, true);
    const faster = (n) => { speed.selectedIndex = clamp(speed.selectedIndex + n, 0, SPEEDS.length - 1); };
    const keys = {
      " ": () => run(!playing), Home: () => go(first, true), End: () => go(end, true),
      ArrowLeft: (n) => step(-n), ArrowRight: step, ArrowUp: () => faster(1), ArrowDown: () => faster(-1),
    };
    root.onkeydown = (event) => {
      const own = event.target === speed || (event.key === " " && event.target.tagName === "BUTTON");
      if (!(event.key in keys) || own || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key](event.shiftKey ? 10 : 1);
    };
    button.onclick = keys[" "];
    slider.oninput = () => go(slider.value * STEP, true);
    add(pick, "span", { class: "small" }, "Crash in test");
    if (scenes.length < 2) pick.remove();
    scenes.forEach((each, i) => { add(pick, "button", { title: each.title }, each.episode).onclick = () => load(i); });
    document.addEventListener("click", ({ target }) => target.dataset.scene && load(+target.dataset.scene));
    load(0);
    new ResizeObserver(() => { if (view.clientWidth && view.clientWidth !== width) layout(); }).observe(view);
  }

  document.querySelectorAll(".player").forEach(play);
})();
