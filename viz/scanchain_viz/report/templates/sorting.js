// Sorts a table by the column whose head is clicked: rising first, then falling; rows without a value come last.
for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  const text = (row, column) => (row.cells[column]?.colSpan === 1 ? row.cells[column].innerText.trim() : "");
  const number = (words) => parseFloat(words.replaceAll(",", ""));
  const sort = (column) => {
    const falls = heads[column].ariaSort === "ascending", sign = falls ? -1 : 1;
    const rows = [...body.rows].map((row) => [text(row, column), row]);
    const isNumeric = rows.some(([words]) => !isNaN(number(words))) && column > 0;
    rows.sort(([a], [b]) => {
      const [x, y] = isNumeric ? [number(a), number(b)] : [a, b];
      const [noX, noY] = [x, y].map((value) => ["", "–"].includes(value) || Number.isNaN(value));
      if (noX || noY) return noX - noY;
      return sign * (isNumeric ? x - y : x.localeCompare(y));
    });
    for (const head of heads) head.ariaSort = "none";
    heads[column].ariaSort = falls ? "descending" : "ascending";
    body.append(...rows.map(([, row]) => row));
  };
  heads.forEach((head, column) => {
    head.ariaSort = "none";
    head.tabIndex = 0;
    head.addEventListener("click", () => sort(column));
    head.addEventListener("keydown", (event) => event.key === "Enter" && sort(column));
  });
}
