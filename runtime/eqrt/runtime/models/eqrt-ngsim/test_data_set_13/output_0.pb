BtrajectoriesJða§?	†¼ap&@I >ùKw@ó¾>£@’5(?àzÉ@Zßp?fWï@Ö²˜?L€
Aw²?npAÉxÂ?+¬0A|É?±XDAaKÅ?ø‹XA0‚·?ñImA£\ ?œAA°ò€?¡
ŒAê_5?	æ–Aœ½>¨²¡A (¥;‡J¬A´1¼¾õ…¶A÷Þ:¿X?ÀA8ê‡¿ÄWÉA1 «¿S¼ÑA‡fÅ¿1lÙAÀ³Ñ¿xàAœ‹Ì¿º.çAƒf±¿RÛíAâ)v¿„õAñyŽ¾=µýATÆ7?UcBÉ¶@ÈÙB|!z@$ BGÈ@