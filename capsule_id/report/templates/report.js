// Sorts a table by the column of the pressed button, copies a text, enlarges a figure, opens the part that a link leads to.
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const cell = button.parentElement, table = cell.closest("table"), body = table.tBodies[0];
    const column = [...cell.parentElement.children].indexOf(cell);
    const down = cell.getAttribute("aria-sort") === "ascending";
    for (const other of cell.parentElement.children) other.removeAttribute("aria-sort");
    cell.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = row => row.children[column].textContent.trim().replaceAll("\u2212", "-");
    const order = (a, b) => {
      const [x, y] = [parseFloat(key(a)), parseFloat(key(b))];
      return isNaN(x) || isNaN(y) ? key(a).localeCompare(key(b)) : x - y;
    };
    const rows = [...body.rows].sort((a, b) => down ? order(b, a) : order(a, b));
    body.append(...rows);
  });
}
for (const button of document.querySelectorAll("button.copy")) {
  button.addEventListener("click", () => {
    getSelection().selectAllChildren(document.getElementById(button.value));
    document.execCommand("copy");
  });
}
const enlarge = (image, x, y) => {
  const figure = image.parentElement, box = image.getBoundingClientRect();
  const [across, down] = [(x - box.left) / box.width, (y - box.top) / box.height];
  figure.classList.toggle("large");
  figure.scrollTo(across * image.width - innerWidth / 2, down * image.height - innerHeight / 2);
};
for (const image of document.querySelectorAll("figure img")) {
  image.addEventListener("click", event => enlarge(image, event.clientX, event.clientY));
  image.addEventListener("keydown", event => { if (event.key === "Enter") enlarge(image, 0, 0); });
}
addEventListener("keydown", event => {
  if (event.key === "Escape") document.querySelector("figure.large")?.classList.remove("large");
});
const reveal = () => document.getElementById(location.hash.slice(1))?.closest("details")?.setAttribute("open", "");
addEventListener("hashchange", reveal);
reveal();
