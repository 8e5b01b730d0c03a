#!/bin/sh
# A cart on a rail, in whole millimetres: a step moves it by the action, which is 0 (left) or 1 (right).
spec='{"environment":"rail-sh","coordinates":[{"name":"x","unit":"mm","sampling":{"kind":"uniform","low":-100,"high":100}}],
"observation":[{"name":"x","term":{"parts":[{"function":"linear","coefficient":1.0,"weights":{"x":1.0}}],"low":null,"high":null}}],"action":{"kind":"discrete","n":2},"start":{"x":{"kind":"fixed","value":0}},"time_limit":50}'
spec=$(printf '%s' "$spec" | tr -d '\n')
x=0
while IFS= read -r line; do
  id=$(printf '%s' "$line" | sed -n 's/.*"id": *\([0-9][0-9]*\).*/\1/p')
  list=$(printf '%s' "$line" | sed -n 's/.*\[\(-*[0-9][0-9]*\).*\].*/\1/p')
  case $line in
    *'"method": "spec"'*) result="\"result\":{\"protocol\":1,\"spec\":$spec}" ;;
    *'"method": "reset"'*) x=0; result="\"result\":{\"state\":[$x]}" ;;
    *'"method": "set"'*) x=$list; result="\"result\":{\"state\":[$x]}" ;;
    *'"method": "get"'*) result="\"result\":{\"state\":[$x]}" ;;
    *'"method": "step"'*'['*) x=$((x + 2 * list - 1)); result="\"result\":{\"state\":[$x],\"reward\":$((-x * x)),\"terminated\":false,\"truncated\":false}" ;;
    *'"method": "save"'*) result="\"result\":{\"snapshot\":\"[$x]\"}" ;;
    *'"method": "restore"'*) x=$list; result="\"result\":{\"state\":[$x]}" ;;
    *'"method": "close"'*) printf '{"id":%s,"result":{}}\n' "$id"; exit 0 ;;
    *'"method": "step"'*) result='"error":"expected an action, got none","code":"invalid"' ;;
    *'"method"'*) result='"error":"expected spec, reset, set, get, step, save, restore or close","code":"unsupported"' ;;
    *) result='"error":"expected a request, got another line","code":"invalid"' ;;
  esac
  printf '{"id":%s,%s}\n' "${id:-null}" "$result"
done
