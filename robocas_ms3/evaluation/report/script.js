"use strict";
// Without this script all rows are shown.
const filters = [...document.querySelectorAll(".filters select")];
const rows = [...document.querySelectorAll("table.filtered tbody tr")];

function show() {
  let count = 0;
  for (const row of rows) {
    row.hidden = filters.some(({ value, dataset }) => value && row.cells[dataset.column].textContent !== value);
    count += !row.hidden;
  }
  document.querySelector("#count").textContent = count;
}

for (const filter of filters) filter.addEventListener("input", show);
if (filters.length) show(); // a browser may keep what was chosen before a reload
