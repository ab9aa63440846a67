// Long tables are sorted by the column whose head is pressed.

function startTables() {
  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = Array.from(table.querySelectorAll("th"));
    heads.forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const descends = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", descends ? "descending" : "ascending");
        sortRows(table.tBodies[0], column, descends ? -1 : 1);
      });
    });
  }
}

function sortRows(body, column, sign) {
  const keyed = Array.from(body.rows, (row) => ({ row, key: sortKey(row.cells[column].textContent) }));
  keyed.sort((a, b) => sign * compare(a.key, b.key));
  body.append(...keyed.map(({ row }) => row));
}

const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹⁻";

// The number that a cell begins with, or its text.
function sortKey(text) {
  const plain = text.replace(/[≤\s\u202f]/g, "").replace("−", "-")
    .replace(/×10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/, (_, power) =>
      "e" + power.replace(/./g, (c) => (c === "⁻" ? "-" : String(SUPERSCRIPTS.indexOf(c)))))
    .replace("∞", "Infinity");
  const value = parseFloat(plain);
  return Number.isNaN(value) ? text.trim() : value;
}

function compare(a, b) {
  if (typeof a === typeof b) return typeof a === "number" ? a - b : a.localeCompare(b);
  return typeof a === "number" ? -1 : 1;
}
