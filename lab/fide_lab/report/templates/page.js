"use strict";

// Charts: which axis is shown, which bands, which optimizers.
for (const charts of document.querySelectorAll(".charts")) {
  const buttons = charts.querySelectorAll("button.axis");
  for (const button of buttons) {
    button.addEventListener("click", () => {
      for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
      for (const chart of charts.querySelectorAll(".chart")) {
        chart.hidden = chart.dataset.axis !== button.dataset.axis;
      }
    });
  }
  const boxes = charts.querySelectorAll("input");
  const show = () => {
    const off = (selector, key) =>
      new Set([...charts.querySelectorAll(selector)].filter((box) => !box.checked).map((box) => box.dataset[key]));
    const parts = off("input.band", "part");
    const series = off("input.series", "series");
    for (const element of charts.querySelectorAll("svg g.wide, svg g.mid, svg g.line, svg path.wide, svg path.mid")) {
      const names = [...element.classList];
      element.classList.toggle("hide", names.some((name) => parts.has(name) || series.has(name)));
    }
  };
  for (const box of boxes) box.addEventListener("change", show);
  show();
}

// Tables: a click on a title sorts by that column, a second one the other way round.
for (const table of document.querySelectorAll("table.sortable")) {
  const titles = [...table.querySelectorAll("thead th")];
  const key = (row, column) => {
    const text = row.cells[column].dataset.sort;
    const value = text === "inf" ? Infinity : text === "-inf" ? -Infinity : Number(text);
    return Number.isNaN(value) ? text : value;
  };
  titles.forEach((title, column) => {
    title.querySelector("button").addEventListener("click", () => {
      const up = title.getAttribute("aria-sort") !== "ascending";
      for (const other of titles) other.setAttribute("aria-sort", "none");
      title.setAttribute("aria-sort", up ? "ascending" : "descending");
      const body = table.tBodies[0];
      const rows = [...body.rows];
      rows.sort((a, b) => {
        const [x, y] = [key(a, column), key(b, column)];
        const order = x < y ? -1 : x > y ? 1 : 0;
        return up ? order : -order;
      });
      body.append(...rows);
    });
  });
}
