// Tables that sort by the column whose head is clicked, and the switch between light and dark.
"use strict";
document.querySelectorAll("table").forEach(function (table) {
  var heads = Array.from(table.tHead.rows[0].cells);
  heads.forEach(function (head, column) {
    head.firstElementChild.addEventListener("click", function () {
      var up = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach(function (other) { other.removeAttribute("aria-sort"); });
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      var body = table.tBodies[0];
      function number(text) { return parseFloat(text.replace(/^[≤≥±]\s*/, "").replace("−", "-")); }
      Array.from(body.rows).sort(function (a, b) {
        var s = a.cells[column].textContent, t = b.cells[column].textContent, p = number(s), q = number(t);
        if (isNaN(p) !== isNaN(q)) return isNaN(p) ? 1 : -1;  // values that are not numbers are last
        var order = isNaN(p) ? s.localeCompare(t) : p - q;
        return up ? order : -order;
      }).forEach(function (row) { body.appendChild(row); });
    });
  });
});
document.querySelector(".theme").addEventListener("click", function () {
  var root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)").matches;
  var now = root.dataset.theme || (dark ? "dark" : "light");
  root.dataset.theme = now === "dark" ? "light" : "dark";
});
