"use strict";
// Moves a cursor over all plots at once and reads out what is under it; the page is whole without it.
(() => {
  const WIDE = 2000, HIGH = 1000;
  const findings = JSON.parse(document.body.dataset.findings);
  const plots = [...document.querySelectorAll(".plot")].map((element) => ({
    element,
    data: JSON.parse(element.dataset.chart),
    plane: element.querySelector(".plane"),
    cursor: element.querySelector(".cursor"),
    readout: element.parentElement.querySelector(".readout"),
    index: -1,
  }));

  const place = (value, [low, high], length) => (value - low) / (high - low) * length;

  function nearest(frames, frame) {
    let low = 0, high = frames.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (frames[middle] < frame) low = middle + 1; else high = middle;
    }
    return low > 0 && frame - frames[low - 1] <= frames[low] - frame ? low - 1 : low;
  }

  function dots({ data }, k) {
    if (data.kind === "names") return [];
    const y = (value) => HIGH - place(value, data.y, HIGH);
    if (data.kind === "curves") {
      const x = place(data.frame[k], data.x, WIDE);
      return data.lines.filter((line) => line.dot).map((line) => [x, line.values[k]])
        .map(([u, value]) => value === null ? null : [u, y(value)]);
    }
    const found = [];
    for (let j = 0; j + 1 < data.lines.length; j += 2) {
      const [u, v] = [data.lines[j].values[k], data.lines[j + 1].values[k]];
      found.push(u === null || v === null ? null : [place(u, data.x, WIDE), y(v)]);
    }
    return found;
  }

  function draw(plot, k) {
    plot.index = k;
    plot.cursor.removeAttribute("hidden");
    const upright = plot.cursor.querySelector(".upright");
    if (upright) {
      const x = place(plot.data.frame[k], plot.data.x, WIDE);
      upright.setAttribute("d", `M${x} 0V${HIGH}`);
    }
    const at = dots(plot, k);
    plot.cursor.querySelectorAll(".dot").forEach((dot, j) => {
      dot.setAttribute("d", at[j] ? `M${at[j][0]} ${at[j][1]}h0` : "");
    });
  }

  function sentence({ data }, k) {
    const frame = data.frame[k];
    const unit = data.unit ? ` ${data.unit}` : "";
    const values = data.kind === "names" ? [data.names[data.values[k]]]
      : data.lines.map((line) => `${line.name} ${line.values[k] === null ? "none" : line.values[k] + unit}`);
    const inside = findings.filter(([, spans]) => spans.some(([a, b]) => a <= frame && frame <= b));
    const rules = [...new Set(inside.map(([rule]) => rule))];
    const last = rules.length ? ` (finding: ${rules.join(", ")})` : "";
    return `frame ${frame}, ${data.t[k].toFixed(3)} s: ${values.join(", ")}${last}`;
  }

  function show(plot, k) {
    draw(plot, k);
    plot.readout.textContent = sentence(plot, k);
    const frame = plot.data.frame[k];
    for (const other of plots) if (other !== plot) draw(other, nearest(other.data.frame, frame));
  }

  function under(plot, event) {
    const box = plot.plane.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * WIDE, y = (event.clientY - box.top) / box.height * HIGH;
    const { data } = plot;
    if (data.kind !== "ways") return nearest(data.frame, data.x[0] + x / WIDE * (data.x[1] - data.x[0]));
    let best = 0, least = Infinity;
    for (let k = 0; k < data.frame.length; k += 1) {
      const [dot] = dots(plot, k);
      if (!dot) continue;
      const far = ((dot[0] - x) * box.width / WIDE) ** 2 + ((dot[1] - y) * box.height / HIGH) ** 2;
      if (far < least) [best, least] = [k, far];
    }
    return best;
  }

  const steps = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -100, PageUp: 100 };

  for (const plot of plots) {
    const last = plot.data.frame.length - 1;
    plot.element.addEventListener("pointermove", (event) => show(plot, under(plot, event)));
    plot.element.addEventListener("pointerdown", (event) => show(plot, under(plot, event)));
    plot.element.addEventListener("focus", () => { if (plot.index < 0) show(plot, 0); });
    plot.element.addEventListener("keydown", (event) => {
      let k = Math.max(plot.index, 0);
      if (event.key in steps) k += steps[event.key] * (event.shiftKey ? 10 : 1);
      else if (event.key === "Home") k = 0;
      else if (event.key === "End") k = last;
      else return;
      event.preventDefault();
      show(plot, Math.min(Math.max(k, 0), last));
    });
  }
})();
