# Runs a command; N stands for the numbers in what it says.
"$@" > said.txt 2>&1
code=$?
sed "s/[0-9][0-9.]*/N/g" said.txt
exit $code
