#!/bin/sh
# In a clean root: the package is installed, its node runs as its unit would run it, and it is upgraded, removed and purged. No
# systemd runs here: what the unit says is checked by `systemd-analyze`, and done by hand.
set -eu
mount -t proc proc /proc
ip link set lo up 2>/dev/null || true

dpkg --install /cara.deb
cara --version
cara-vda5050 --version
man --where cara cara-node cara-vda5050 > /dev/null
[ -s /var/lib/dpkg/info/cara.md5sums ]
# It ends with 0 whatever it finds, and prints that.
[ -z "$(dpkg --verify cara)" ]
for file in cara/prometheus/cara.rules.yml cara/grafana/cara.json doc/cara/copyright doc/cara/book/index.html doc/cara/book/searchindex.js; do
    [ -f "/usr/share/$file" ]
done
[ "$(stat --format=%U:%G:%a /etc/cara)" = root:cara:750 ]
systemd-analyze verify --man=no cara@plant.service cara-standby@plant.service cara-vda5050.service

mkdir /etc/cara/keys /run/cara /var/lib/cara
cara keys --dir /etc/cara/keys new-fleet --fleet 7 plant/1@m_unit agv/7 > /dev/null
printf 'name = "plant"\nid = 1\nfleet = 7\ninterfaces = "lo"\n' > /etc/cara/plant.toml
cp /usr/share/doc/cara/vda5050.toml /usr/share/doc/cara/example-factsheet.json /etc/cara
sed -i 's#^state_folder = .*#state_folder = "/var/lib/cara-vda5050"#' /etc/cara/vda5050.toml
mkdir /var/lib/cara-vda5050
cara keys --dir /etc/cara/keys new-fleet --fleet 42 vda5050/1@m_unit agv-1/101 > /dev/null
chmod 700 /run/cara /var/lib/cara /var/lib/cara-vda5050
chown --recursive cara:cara /etc/cara/keys /run/cara /var/lib/cara /var/lib/cara-vda5050

as_unit="setpriv --reuid=cara --regid=cara --init-groups --no-new-privs env CARA_CONTROL_DIR=/run/cara STATE_DIRECTORY=/var/lib/cara"
$as_unit cara node --check /etc/cara/plant.toml
$as_unit env CARA_KEYS=/etc/cara/keys cara-vda5050 --check /etc/cara/vda5050.toml
# What systemd does not try again: RestartPreventExitStatus= of both units.
for program in 'cara node' cara-vda5050; do
    code=0
    $as_unit $program /etc/cara/none.toml || code=$?
    [ "$code" = 2 ]
done
$as_unit cara node /etc/cara/plant.toml > /node.log 2>&1 &
node=$!
for _ in $(seq 300); do
    $as_unit cara orders > /dev/null 2>&1 && break
    sleep 0.1
done
$as_unit cara orders > /dev/null || { cat /node.log; exit 1; }

# An upgrade leaves the running node, its settings and its claims alone.
chown root:root /etc/cara
chmod 755 /etc/cara
before=$(sha256sum /etc/cara/plant.toml /var/lib/cara/*)
dpkg --install /cara.deb
$as_unit cara orders > /dev/null
[ "$(stat --format=%U:%G:%a /etc/cara)" = root:root:755 ]
[ "$before" = "$(sha256sum /etc/cara/plant.toml /var/lib/cara/*)" ]
kill "$node"
wait "$node"

dpkg --remove cara
[ ! -e /usr/bin/cara ]
[ -e /etc/cara/plant.toml ]
dpkg --purge cara
[ -e /etc/cara/keys ]
[ -n "$(ls /var/lib/cara)" ]
echo "all well"
