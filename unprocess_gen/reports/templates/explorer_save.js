if (file.data.name.length) {
  const bytes = Uint8Array.from(atob(file.data.content[0]), letter => letter.charCodeAt(0));
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([bytes], {type: "application/zip"}));
  link.download = file.data.name[0];
  link.click();
}
