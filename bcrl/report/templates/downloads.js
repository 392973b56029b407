"use strict";
// What a panel shows as a file: its values as CSV, the picture as SVG or PNG. The files
// are made in the browser; nothing is fetched or sent.
const downloads = (() => {
  const PIXELS = 3; // of a PNG per unit of the picture
  const ROW = 16; // height of a line of text in the legend
  const STYLES = [
    "fill", "stroke", "stroke-width", "stroke-dasharray", "stroke-linejoin", "opacity",
    "font-family", "font-size", "font-weight",
  ];
  const COLUMNS = {
    mean: "mean", low: "interval_low", high: "interval_high",
    median: "median", q1: "quartile_1", q3: "quartile_3",
  };

  function save(blob, name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  }

  /** One row per curve that is drawn and point; what isn't finite is empty. */
  function csv(view, data) {
    const cell = (value) => {
      const text = String(value ?? "");
      return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    };
    const rows = [["variant", "metric", "task", data.counter, ...Object.values(COLUMNS)]];
    for (const { series, places } of view.lines) {
      const found = series.metrics[view.metric];
      for (const i of places) {
        const values = Object.keys(COLUMNS).map((key) => found[key][i]);
        rows.push([series.name, view.metric, series.task[i], series.x[i], ...values]);
      }
    }
    return rows.map((row) => `${row.map(cell).join(",")}\n`).join("");
  }

  /** The panel with its caption and the legend, in a light page's colours. */
  function picture(view, data, tools) {
    const { svg, coloured } = tools;
    const [, , width, height] = view.svg.getAttribute("viewBox").split(" ").map(Number);
    const root = svg("svg", { class: "export" });
    const title = svg("text", { x: 4, y: 14, class: "title" }, data.labels[view.metric]);
    const inner = view.svg.cloneNode(true);
    const drawn = svg("g", { transform: "translate(0 20)" }, ...inner.childNodes);
    drawn.querySelector(".overlay").remove();
    const legend = svg("g");
    const paper = svg("rect", { class: "paper" });
    root.append(paper, title, drawn, legend);
    view.panel.append(root);
    let x = 4, y = height + 20 + ROW;
    for (const { series } of view.lines) {
      const name = svg("text", { x: 28 }, series.name);
      const stroke = { d: "M0 -4H22", class: "centre", "stroke-dasharray": series.dash };
      const entry = coloured(svg("g", {}, svg("path", stroke), name), series);
      legend.append(entry);
      const wide = 28 + name.getComputedTextLength() + 14;
      if (x > 4 && x + wide > width) { x = 4; y += ROW; }
      entry.setAttribute("transform", `translate(${x} ${y})`);
      x += wide;
    }
    y += ROW;
    legend.append(svg("text", { x: 4, y }, view.drawn));
    const size = { width, height: y + 8 };
    for (const [key, value] of Object.entries(size)) {
      root.setAttribute(key, value);
      paper.setAttribute(key, value);
    }
    document.documentElement.classList.add("light");
    const drawing = [...root.querySelectorAll("path, rect, circle, text")];
    const styles = drawing.map((element) => {
      const computed = getComputedStyle(element);
      return STYLES.map((name) => [name, computed.getPropertyValue(name)]);
    });
    document.documentElement.classList.remove("light");
    root.remove();
    drawing.forEach((element, i) => {
      styles[i].forEach(([name, value]) => element.setAttribute(name, value));
    });
    for (const element of [root, ...root.querySelectorAll("*")]) {
      element.removeAttribute("class");
      element.removeAttribute("style");
    }
    root.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
    return { text: new XMLSerializer().serializeToString(root), ...size };
  }

  async function png({ text, width, height }) {
    const image = new Image();
    image.src = `data:image/svg+xml,${encodeURIComponent(text)}`;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [width * PIXELS, height * PIXELS];
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    return new Promise((done) => { canvas.toBlob(done, "image/png"); });
  }

  /** Buttons that save a panel; `view()` is what it shows at the time. */
  function buttons(view, data, tools) {
    const { html } = tools;
    const kinds = {
      CSV: () => new Blob([csv(view(), data)], { type: "text/csv" }),
      SVG: () => new Blob([picture(view(), data, tools).text], { type: "image/svg+xml" }),
      PNG: () => png(picture(view(), data, tools)),
    };
    const { metric } = view();
    return Object.entries(kinds).map(([kind, made]) => {
      const label = `Download ${data.labels[metric]} as ${kind}`;
      const button = html("button", { type: "button", "aria-label": label }, kind);
      const name = `${data.id}-${metric}`.replace(/[^\w.@-]+/g, "_");
      button.addEventListener("click", async () => {
        save(await made(), `${name}.${kind.toLowerCase()}`);
      });
      return button;
    });
  }

  return { buttons };
})();
