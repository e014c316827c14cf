BtrajectoriesJð\áq@’¡Ú¼vFò@
ß	½ìå5AHi™¼ã«rAxÁ<ð²—Aœ	¥=Ž¶AÒ(>:GÔAÞ×Š>ãxòA@äË>MLB×`?$SBHH5?<Q&Bi5c?G5B«[Š?
5DB¬±¤?ÊSBxlÀ?ÃûaBÌaÝ?JÕpB>nû?¨Bµ:@Ï:‡BÔ0@$žŽBª‘-@þ•B·W>@‹ZBþ~O@ ³¤BÖa@›¬BŠár@¹W³Bjˆ‚@N£ºBðÂ‹@RêÁB•@à,ÉB@wž@ikÐBÜÏ§@¥¦×BC±@ÇßÞBÿö¹@