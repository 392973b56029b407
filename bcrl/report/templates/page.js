"use strict";
// Learning curves: one block of linked panels per environment, drawn from the JSON that
// is in the page. Text from it only ever becomes text, never markup.
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const MARGIN = { left: 52, right: 10, top: 18, bottom: 34 };
  const HEIGHT = 250;
  const PRINTED = 340; // width of a panel on paper, two beside each other on A4

  const html = (name, attributes = {}, ...children) =>
    filled(document.createElement(name), attributes, children);
  const svg = (name, attributes = {}, ...children) =>
    filled(document.createElementNS(SVG, name), attributes, children);

  function filled(element, attributes, children) {
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  }

  function coloured(element, series) {
    element.classList.add("series");
    element.style.setProperty("--light", series.light);
    element.style.setProperty("--dark", series.dark);
    return element;
  }

  function number(value, digits = 5) {
    if (value === null || value === undefined) return "–";
    const size = Math.abs(value);
    const text = size && (size < 1e-3 || size >= 1e7)
      ? value.toExponential(digits - 1)
      : String(+value.toPrecision(digits));
    return text.replaceAll("-", "−");
  }

  function ticks(low, high, wanted) {
    const rough = (high - low) / wanted;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].find((each) => each * power >= rough) * power;
    const found = [];
    for (let n = Math.ceil(low / step); n * step <= high + step * 1e-9; n++) {
      found.push(+(n * step).toPrecision(12));
    }
    return found;
  }

  /** `M…L…` through the points; a null interrupts the line. */
  function line(xs, ys, toX, toY) {
    let path = "", pen = "M";
    xs.forEach((x, i) => {
      if (ys[i] === null) { pen = "M"; return; }
      path += `${pen}${toX(x).toFixed(1)} ${toY(ys[i]).toFixed(1)}`;
      pen = "L";
    });
    return path;
  }

  /** The area between two curves, one closed shape for each stretch without nulls. */
  function area(xs, lows, highs, toX, toY) {
    let path = "", stretch = [];
    const close = () => {
      if (stretch.length > 1) {
        const at = (i, ys) => `${toX(xs[i]).toFixed(1)} ${toY(ys[i]).toFixed(1)}`;
        const back = [...stretch].reverse();
        path += `M${stretch.map((i) => at(i, lows)).join("L")}`;
        path += `L${back.map((i) => at(i, highs)).join("L")}Z`;
      }
      stretch = [];
    };
    xs.forEach((_, i) => (lows[i] === null || highs[i] === null ? close() : stretch.push(i)));
    close();
    return path;
  }

  class Block {
    constructor(place, data) {
      this.data = data;
      this.state = {
        off: new Set(data.series.filter((s) => !s.on).map((s) => s.name)),
        metrics: new Set(data.shown),
        centre: "mean", spread: true, seeds: false, target: data.target, zoom: null,
      };
      this.cursor = null;
      this.panels = html("div", { class: "panels" });
      this.live = html("p", { class: "unseen", role: "status" });
      this.hint = `hint-${data.id}`;
      const hint = "Hover, tap, or focus a panel and use the arrow keys, for values; drag, or "
        + "+ and −, to zoom; double-click or Esc shows all. Shift-click shows one method only.";
      const help = html("p", { class: "hint", id: this.hint }, hint);
      this.about = html("p", { class: "hint about" });
      place.append(this.controls(), this.panels, this.about, help, this.live);
      this.draw();
      // On paper a panel has another width; a tap elsewhere takes the values away.
      const printing = (on) => () => { this.printing = on; this.draw(); };
      window.addEventListener("beforeprint", printing(true));
      window.addEventListener("afterprint", printing(false));
      document.addEventListener("pointerdown", (event) => {
        if (!this.panels.contains(event.target)) this.leave();
      });
      let width = this.panels.clientWidth;
      new ResizeObserver(() => {
        if (this.panels.clientWidth === width) return;
        width = this.panels.clientWidth;
        this.draw();
      }).observe(this.panels);
    }

    // --- controls

    button(text, pressed, act, kind = "") {
      const made = html("button", { type: "button", class: kind }, text);
      const show = () => made.setAttribute("aria-pressed", String(pressed()));
      made.addEventListener("click", (event) => {
        act(event);
        this.shows.forEach((each) => each());
        this.draw();
      });
      this.shows.push(show);
      show();
      return made;
    }

    controls() {
      this.shows = [];
      const { state, data } = this;
      const group = (name, kind, ...buttons) => html(
        "div", { role: "group", "aria-label": name, class: kind },
        html("span", { class: "label" }, name), ...buttons,
      );
      const toggle = (set, name) => (set.has(name) ? set.delete(name) : set.add(name));
      const methods = data.series.map((series) => {
        const act = (event) => {
          if (!event.shiftKey) { toggle(state.off, series.name); return; }
          data.series.forEach((each) => state.off.add(each.name));
          state.off.delete(series.name);
        };
        const made = this.button(series.name, () => !state.off.has(series.name), act, "method");
        const stroke = svg("path", { d: "M1 5H21", class: "centre", "stroke-dasharray": series.dash });
        made.prepend(svg("svg", { width: 22, height: 10, "aria-hidden": "true" }, stroke));
        return coloured(made, series);
      });
      const metrics = data.metrics.map((metric) => {
        const act = () => toggle(state.metrics, metric);
        const made = this.button(metric, () => state.metrics.has(metric), act);
        made.title = data.labels[metric];
        return made;
      });
      const centre = (key, text) => this.button(
        text, () => state.centre === key, () => { state.centre = key; },
      );
      const flag = (key, text) => this.button(
        text, () => state[key], () => { state[key] = !state[key]; },
      );
      const shown = [
        centre("mean", "mean"), centre("median", "median"),
        flag("spread", "interval"), flag("seeds", "single seeds"),
      ];
      const zooms = [["+", "zoom in", 0.5], ["−", "zoom out", 2]].map(([sign, name, factor]) => {
        const made = html("button", { type: "button", "aria-label": name, title: name }, sign);
        made.addEventListener("click", () => this.scale(factor));
        return made;
      });
      if (data.courses) shown.push(flag("target", "target task only"));
      return html(
        "div", { class: "controls" },
        group("methods", "legend", ...methods), group("show", "", ...shown),
        group("zoom", "", ...zooms),
        group("metrics", "", ...metrics),
      );
    }

    // --- drawing

    get visible() {
      return this.data.series.filter((series) => !this.state.off.has(series.name));
    }

    /** Places of a series' points that are to be drawn. */
    places(series) {
      const all = series.x.map((_, i) => i);
      return this.state.target ? all.filter((i) => series.task[i] === series.target) : all;
    }

    get domain() {
      if (this.state.zoom) return this.state.zoom;
      const ends = this.data.spans.flatMap((span) => [span[1], span[2]]);
      const all = this.data.series.flatMap((series) => [series.x[0], series.x.at(-1)]);
      const low = Math.min(...ends, ...all), high = Math.max(...ends, ...all);
      return low < high ? [low, high] : [low - 0.5, high + 0.5];
    }

    /** What lines and bands are, in words. */
    get drawn() {
      const { centre, spread, seeds } = this.state;
      const bands = { mean: "95 % bootstrap interval", median: "quartiles" };
      return [
        `${centre} over seeds`, ...(spread ? [`band: ${bands[centre]}`] : []),
        ...(seeds ? ["thin: single seeds"] : []),
      ].join(", ");
    }

    draw() {
      this.cursor = null;
      this.about.textContent = `Lines: ${this.drawn}.`;
      const shown = this.data.metrics.filter((metric) => this.state.metrics.has(metric));
      const focused = document.activeElement?.closest?.(".panel")?.dataset.metric;
      this.panels.replaceChildren(...shown.map((metric) => this.panel(metric)));
      this.views = shown.map((metric, i) => this.plot(metric, this.panels.children[i]));
      this.views.forEach((view) => {
        const now = () => this.views.find(({ metric }) => metric === view.metric);
        const saving = downloads.buttons(now, this.data, { html, svg, coloured });
        view.panel.firstChild.append(html("span", { class: "saving" }, ...saving));
      });
      this.views.find((view) => view.metric === focused)?.svg.focus();
    }

    panel(metric) {
      const caption = html("figcaption", {}, this.data.labels[metric]);
      return html("figure", { class: "panel", "data-metric": metric }, caption);
    }

    plot(metric, panel) {
      const width = this.printing ? PRINTED : Math.max(240, panel.clientWidth);
      const [x0, x1] = this.domain;
      const right = width - MARGIN.right, bottom = HEIGHT - MARGIN.bottom;
      const toX = (x) => MARGIN.left + ((x - x0) / (x1 - x0)) * (right - MARGIN.left);
      const lines = this.visible.filter((s) => s.metrics[metric]).map((series) => {
        const places = this.places(series);
        const found = series.metrics[metric], [low, high] = this.state.centre === "mean"
          ? [found.low, found.high] : [found.q1, found.q3];
        const pick = (values) => places.map((i) => values[i]);
        return {
          series, places, x: pick(series.x), task: pick(series.task),
          y: pick(found[this.state.centre]), low: pick(low), high: pick(high),
          seeds: this.state.seeds ? found.seeds.map(pick) : [],
          far: found.far,
        };
      });
      const optimum = metric === "return" ? this.data.optimum : null;
      const [y0, y1] = this.range(lines, optimum);
      const toY = (y) => bottom - ((y - y0) / (y1 - y0)) * (bottom - MARGIN.top);
      const root = svg("svg", {
        viewBox: `0 0 ${width} ${HEIGHT}`, tabindex: 0, role: "application",
        "aria-roledescription": "chart", "aria-describedby": this.hint,
        "aria-label": `${this.data.labels[metric]} over ${this.data.axis}: ${lines.map((l) => l.series.name).join(", ")}`,
      });
      const clip = `clip-${this.data.id}-${metric}`;
      const frame = {
        x: MARGIN.left, y: MARGIN.top,
        width: right - MARGIN.left, height: bottom - MARGIN.top,
      };
      root.append(svg("clipPath", { id: clip }, svg("rect", frame)));
      this.backdrop(root, toX, [x0, x1], bottom);
      for (const y of ticks(y0, y1, 5)) {
        root.append(
          svg("path", { d: `M${MARGIN.left} ${toY(y)}H${right}`, class: "grid" }),
          svg("text", { x: MARGIN.left - 6, y: toY(y) + 4, "text-anchor": "end" }, number(y)),
        );
      }
      for (const x of ticks(x0, x1, width / 90)) {
        const edge = toX(x) > width - 24;
        const at = { x: edge ? width : toX(x), y: bottom + 14 };
        at["text-anchor"] = edge ? "end" : "middle";
        root.append(svg("text", at, x.toLocaleString("en").replaceAll(",", "\u2009")));
      }
      const middle = { x: (MARGIN.left + right) / 2, y: HEIGHT - 5, "text-anchor": "middle" };
      root.append(svg("text", middle, this.data.axis));
      const inside = svg("g", { "clip-path": `url(#${clip})` });
      root.append(inside);
      if (optimum !== null) {
        const y = toY(optimum), above = y > MARGIN.top + 15;
        const at = { x: right - 3, y: above ? y - 4 : y + 12, "text-anchor": "end" };
        const d = `M${MARGIN.left} ${y}H${right}`;
        inside.append(svg("path", { d, class: "optimum" }), svg("text", at, "optimum"));
      }
      for (const each of lines) {
        const g = coloured(svg("g", { "data-method": each.series.name }), each.series);
        for (const seed of each.seeds) {
          g.append(svg("path", { d: line(each.x, seed, toX, toY), class: "seed" }));
        }
        if (this.state.spread) {
          const d = area(each.x, each.low, each.high, toX, toY);
          g.append(svg("path", { d, class: "interval" }));
        }
        const d = line(each.x, each.y, toX, toY);
        g.append(svg("path", { d, class: "centre", "stroke-dasharray": each.series.dash }));
        inside.append(g);
      }
      const overlay = svg("g", { class: "overlay" });
      root.append(overlay);
      panel.append(root);
      const xs = [...new Set(lines.flatMap((l) => l.x))]
        .filter((x) => x >= x0 && x <= x1).sort((a, b) => a - b);
      const { drawn } = this;
      const view = {
        metric, panel, svg: root, overlay, lines, drawn, xs, toX, toY, width, right, bottom,
      };
      this.listen(view);
      return view;
    }

    /** Task bands with their names, which take two rows where they are narrow. */
    backdrop(root, toX, [x0, x1], bottom) {
      let last = -Infinity;
      this.data.spans.forEach(([name, start, end], i) => {
        const a = Math.max(start, x0), b = Math.min(end, x1);
        if (a >= b) return;
        const x = toX(a), width = toX(b) - x;
        root.append(svg("rect", {
          x, y: MARGIN.top, width, height: bottom - MARGIN.top,
          class: i % 2 ? "band-b" : "band-a",
        }));
        const middle = x + width / 2;
        if (middle - last < 22) return;
        last = middle;
        root.append(svg("text", { x: middle, y: MARGIN.top - 5, "text-anchor": "middle" }, name));
      });
    }

    /** What the y-axis shows: centre lines, intervals and seeds within the zoom. */
    range(lines, optimum) {
      const [x0, x1] = this.domain;
      let low = Infinity, high = -Infinity;
      const take = (xs, ys) => ys.forEach((y, i) => {
        if (y === null || xs[i] < x0 || xs[i] > x1) return;
        low = Math.min(low, y);
        high = Math.max(high, y);
      });
      // Curves that diverge would flatten the others; the notes name them.
      const near = lines.filter((each) => !each.far);
      for (const each of near.length ? near : lines) {
        take(each.x, each.y);
        if (this.state.spread) { take(each.x, each.low); take(each.x, each.high); }
        each.seeds.forEach((seed) => take(each.x, seed));
      }
      if (!Number.isFinite(low)) return [0, 1];
      if (optimum !== null) {
        low = Math.min(low, optimum);
        high = Math.max(high, optimum);
      }
      // What differs in its last digits only is drawn as if it were equal.
      const differs = high - low > Math.abs(low) * 1e-6;
      const room = (differs ? high - low : Math.abs(low)) * 0.05 || 0.5;
      return [low - room, high + room];
    }

    // --- looking closer

    listen(view) {
      const [x0, x1] = this.domain;
      const dataX = (event) => {
        const box = view.svg.getBoundingClientRect();
        const px = ((event.clientX - box.left) / box.width) * view.width;
        const share = (px - MARGIN.left) / (view.right - MARGIN.left);
        return Math.min(x1, Math.max(x0, x0 + share * (x1 - x0)));
      };
      let from = null;
      view.svg.addEventListener("pointermove", (event) => {
        this.point(view, dataX(event), from);
      });
      view.svg.addEventListener("pointerleave", (event) => {
        // A finger that is lifted leaves, too: its values stay.
        if (from === null && event.pointerType !== "touch") this.leave();
      });
      view.svg.addEventListener("pointerdown", (event) => {
        if (event.pointerType !== "mouse" || event.button) return;
        from = dataX(event);
        view.svg.setPointerCapture(event.pointerId);
      });
      view.svg.addEventListener("pointerup", (event) => {
        const start = from;
        from = null;
        if (start === null) return;
        const ends = [start, dataX(event)].sort((a, b) => a - b);
        if (ends[1] - ends[0] > (x1 - x0) / 50) this.zoom(ends);
      });
      view.svg.addEventListener("click", (event) => { // also a tap, after what it blurs
        if (!this.views.includes(view)) return;
        this.point(view, dataX(event));
        this.say(view);
      });
      view.svg.addEventListener("dblclick", () => this.zoom(null));
      view.svg.addEventListener("blur", () => this.leave());
      view.svg.addEventListener("keydown", (event) => {
        const { xs } = view;
        const now = xs.indexOf(this.cursor ?? NaN), end = xs.length - 1;
        const go = (x) => { this.point(view, x); this.say(view); };
        const act = {
          ArrowLeft: () => go(xs[now < 0 ? end : Math.max(0, now - 1)]),
          ArrowRight: () => go(xs[now < 0 ? 0 : Math.min(end, now + 1)]),
          Home: () => go(xs[0]),
          End: () => go(xs[end]),
          "+": () => this.scale(0.5),
          "-": () => this.scale(2),
          Escape: () => this.zoom(null),
        }[event.key];
        if (!act || !xs.length) return;
        event.preventDefault();
        act();
      });
    }

    /** Zoom by a factor around the values that were shown last. */
    scale(factor) {
      const [x0, x1] = this.domain, { last } = this;
      if (factor > 1 && !this.state.zoom) return;
      const around = last >= x0 && last <= x1 ? last : (x0 + x1) / 2;
      const [a, b] = [around - (around - x0) * factor, around + (x1 - around) * factor];
      this.zoom(factor > 1 && b - a >= this.full ? null : [a, b]);
    }

    zoom(ends) {
      if (!this.state.zoom) this.full = this.domain[1] - this.domain[0];
      // Closer than one count there is nothing, and numbers are too coarse for ticks.
      if (ends && ends[1] - ends[0] < Math.max(1, this.full * 1e-6)) return;
      this.state.zoom = ends;
      this.draw();
    }

    leave() {
      this.cursor = null;
      this.views.forEach((view) => {
        view.overlay.replaceChildren();
        view.panel.querySelector(".tip")?.remove();
      });
    }

    /** Show the values next to `x`, in all panels; those of `view` as numbers, too. */
    point(view, x, from = null) {
      this.leave();
      if (from !== null) {
        const [a, b] = [view.toX(from), view.toX(x)].sort((p, q) => p - q);
        view.overlay.append(svg("rect", {
          x: a, y: MARGIN.top, width: b - a, height: view.bottom - MARGIN.top, class: "zoomed",
        }));
        return;
      }
      if (!view.xs.length) return;
      const near = (values) => values.reduce(
        (best, each, i) => (Math.abs(each - x) <= Math.abs(values[best] - x) ? i : best), 0,
      );
      const at = view.xs[near(view.xs)];
      this.cursor = this.last = x = at;
      for (const each of this.views) {
        const d = `M${each.toX(at)} ${MARGIN.top}V${each.bottom}`;
        each.overlay.append(svg("path", { d, class: "cursor" }));
        const found = [];
        for (const one of each.lines) {
          const i = near(one.x);
          const beyond = at < one.x[0] || at > one.x.at(-1);
          if (one.y[i] === null || beyond) continue;
          found.push([one, i]);
          const centre = { cx: each.toX(one.x[i]), cy: each.toY(one.y[i]), r: 4, class: "dot" };
          each.overlay.append(coloured(svg("circle", centre), one.series));
        }
        if (each === view) this.tip(view, at, found);
        each.found = found;
      }
    }

    /** Tell screen readers the values at the cursor. */
    say(view) {
      if (this.cursor === null) return;
      const values = view.found.map(([one, i]) => `${one.series.name} ${number(one.y[i])}, `
        + `from ${number(one.low[i], 4)} to ${number(one.high[i], 4)}, T${one.task[i]}`);
      const at = `${this.data.counter} ${number(this.cursor, 9)}`;
      this.live.textContent = `${at}: ${values.join("; ") || "no values"}`;
    }

    tip(view, at, found) {
      const head = html("strong", {}, `${this.data.counter} ${number(at, 9)}`);
      const rows = found.map(([one, i]) => html(
        "tr", { "data-method": one.series.name },
        html("td", {}, coloured(html("span", { class: "swatch" }), one.series)),
        html("td", {}, one.series.name),
        html("td", { class: "value" }, number(one.y[i])),
        html("td", {}, html("small", {}, `[${number(one.low[i], 4)}, ${number(one.high[i], 4)}]`)),
        html("td", {}, html("small", {}, `T${one.task[i]}${
          one.x[i] === at ? "" : ` at ${number(one.x[i], 9)}`}`)),
      ));
      const tip = html("div", { class: "tip", "aria-hidden": "true" }, head);
      tip.append(html("table", {}, html("tbody", {}, ...rows)));
      view.panel.append(tip);
      const [outer, inner] = [view.panel, view.svg].map((e) => e.getBoundingClientRect());
      const x = view.toX(at) * (inner.width / view.width), room = outer.width;
      const left = x + 14 + tip.offsetWidth <= room ? x + 14 : x - 14 - tip.offsetWidth;
      tip.style.left = `${Math.max(0, Math.min(left, room - tip.offsetWidth))}px`;
      // Below the curves, unless that is out of sight.
      const fits = inner.bottom + tip.offsetHeight < window.innerHeight;
      const top = fits ? inner.bottom - MARGIN.bottom : inner.top + MARGIN.top;
      tip.style.top = `${top - outer.top + 4}px`;
    }
  }

  const data = JSON.parse(document.getElementById("curves-data").textContent);
  for (const place of document.querySelectorAll("[data-curves]")) {
    new Block(place, data[Number(place.dataset.curves)]);
  }

  // Animations can be stopped; the still picture is there for reduced motion, too.
  for (const picture of document.querySelectorAll(".moving")) {
    const source = picture.querySelector("source");
    let moves = !window.matchMedia(source.media).matches;
    const button = html("button", { type: "button" });
    const show = () => {
      source.media = moves ? "not all" : "all";
      button.textContent = moves ? "stop" : "play";
    };
    button.addEventListener("click", () => { moves = !moves; show(); });
    show();
    picture.parentElement.querySelector("figcaption").append(" ", button);
  }
})();
